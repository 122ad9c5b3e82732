"""Checks of the cameras' intrinsics in a transforms.json: sizes, focal lengths, principal points and lenses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType

from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.values import Number, check_number, check_row, cut, shown

POSITIVE = Number(0, above=True)
SIDE = Number(1, 65536)
"""Pixels along a side of an image."""
FOCAL_SHARES = (1e-3, 1e4)
"""Plausible focal lengths, in widths of the image."""
WHOLE_SPHERE = {"fl_x": 0.5, "fl_y": 1.0}
"""Focal lengths of an equirectangular image all round, in sides of the image; smaller ones would show it twice."""
MODELS = {
    name: kind for name, kind in CAMERA_MODEL_TO_TYPE.items() if not name.startswith(("OMNIDIRECTIONALSTEREO", "VR180"))
}
"""Names of camera models; those of image pairs have no pose for each image."""
LONG_LENS = 12
"""Coefficients that nerfstudio needs of a FISHEYE624."""
CAMERA = ("fl_x", "fl_y", "cx", "cy", "w", "h")
RADIAL, TANGENTIAL = ("k1", "k2", "k3", "k4"), ("p1", "p2")
STRETCH = 10.0
"""Distortion that displaces a point half way to a corner by more than this factor is a mistake."""


def check_lenses(meta: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Checks the intrinsics of every camera; as in nerfstudio, a value for all frames overrides that of a frame.

    Raises:
        InputError: a value is missing, is no number, or cannot be a lens; names the file, the frame and the field.
    """
    model = meta.get("camera_model", "OPENCV")
    if not isinstance(model, str) or model not in MODELS:
        raise InputError(f"The camera_model of {path} is {shown(model)}: give one of {', '.join(MODELS)}.")
    for key in CAMERA:
        lacking = next((f for f in frames if key not in f), None) if key not in meta else None
        if lacking is not None:
            raise InputError(f"{path} has no {key}, neither for all frames nor in {cut(lacking['file_path'])}: add it.")
    # With one coefficient for all frames nerfstudio reads none of a frame.
    is_shared = bool(set(meta) & {"k1", "k2", "k3", *TANGENTIAL, "distortion_params"})
    checked: set[tuple] = set()
    for frame in frames:
        source = meta if is_shared else {k: v for k, v in frame.items() if k not in meta}
        lens = {k: v for k, v in source.items() if k in (*RADIAL, *TANGENTIAL)}
        params = source.get("distortion_params")
        camera = {k: meta.get(k, frame.get(k)) for k in CAMERA}
        key = (repr(camera), repr(lens), repr(params))
        if key not in checked:
            checked.add(key)
            where = path if is_shared and set(meta) >= set(CAMERA) else f"{cut(frame['file_path'])} in {path}"
            _check_camera(camera, lens, params, MODELS[model], str(where))


def _check_camera(
    camera: Mapping[str, Any], lens: Mapping[str, Any], params: Any, kind: CameraType, where: str
) -> None:
    for key in ("w", "h"):
        check_number(f"The {key} of {where}", camera[key], SIDE)
        if camera[key] != int(camera[key]):
            raise InputError(f"The {key} of {where} must be whole pixels, not {shown(camera[key])}.")
    for key, side in (("fl_x", "w"), ("fl_y", "h")):
        check_number(f"The focal length {key} of {where}", camera[key], POSITIVE)
        share, (least, most) = camera[key] / camera[side], FOCAL_SHARES
        if kind == CameraType.EQUIRECTANGULAR:
            least = WHOLE_SPHERE[key]
        if kind != CameraType.ORTHOPHOTO and not 0.99 * least <= share <= most:
            raise InputError(
                f"The focal length {key} of {where} is {camera[key]:g} pixels in an image of {camera[side]:g}: give "
                f"it in pixels, between {least:g} and {most:g} times the image's side."
            )
    for key, side in (("cx", "w"), ("cy", "h")):
        check_number(f"The {key} of {where}", camera[key], Number())
        if not 0 <= camera[key] <= camera[side]:
            raise InputError(
                f"The principal point {key} of {where} is {camera[key]:g}, outside the image of {camera[side]:g} "
                "pixels: give cx, cy, w and h for images of one size."
            )
    for key, value in lens.items():
        check_number(f"The distortion {key} of {where}", value, Number(-1, 1) if key in TANGENTIAL else Number())
    if params is not None or kind == CameraType.FISHEYE624:
        count = LONG_LENS if kind == CameraType.FISHEYE624 else 6
        check_row(f"The distortion_params of {where}", params, count, Number())
        lens = dict(zip(RADIAL, params or (), strict=False))
    if kind not in (CameraType.PERSPECTIVE, CameraType.FISHEYE):
        return
    # The radial polynomial must rise up to half way to a corner (a tangent, or the angle of a fisheye).
    radius = 0.25 * math.hypot(camera["w"] / camera["fl_x"], camera["h"] / camera["fl_y"])
    r = radius * np.linspace(0, STRETCH, 2001)[1:]
    with np.errstate(over="ignore", invalid="ignore"):
        distorted = r + sum(float(lens.get(k, 0)) * r ** (2 * n + 3) for n, k in enumerate(RADIAL))
        reached = np.nonzero(~(distorted < radius))[0]
        first = int(reached[0]) if len(reached) else len(r) - 1
        rises = bool((np.diff(np.append(0.0, distorted[: first + 1])) > 0).all())
    if not (len(reached) > 0 and rises and float(r[first]) >= radius / STRETCH):
        said = ", ".join(f"{k} {lens[k]:g}" for k in RADIAL if k in lens)
        raise InputError(
            f"The distortion of {where} ({said}) cannot be undone half way to the image's corners: give OpenCV's "
            "coefficients for this camera_model, or undistorted images without any."
        )
