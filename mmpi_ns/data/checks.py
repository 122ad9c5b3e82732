"""Checks of the input before nerfstudio reads it, where its errors name neither frame nor remedy."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from mmpi_ns.utils.errors import InputError, brief, looked_at
from mmpi_ns.utils.files import opened
from mmpi_ns.utils.values import Number, as_text, check_number, check_text, cut

FLOAT64_SAME = 1e-12
"""Cameras of a file closer together than this fraction of their distance from the origin count as one place."""
ROTATION_SLACK = 0.01
"""Tolerance on the length of the axes of a pose, which should be 1."""
MAP_COORDINATES = 2000.0
"""Distance of the cameras from the origin, relative to their extent, above which float32 cannot represent their
positions."""
FAR_OFF, FEW = 1000.0, 0.1
"""A camera this many times as far away as all but a few others, this fraction of them, is a mistake."""
FOCAL_SHARES = (1e-3, 1e4)
"""Plausible focal lengths, in sides of the image."""
WHOLE_SPHERE = {"fl_x": 0.5, "fl_y": 1.0}
"""Minimum focal lengths of an equirectangular image, in sides of the image; smaller ones would repeat it."""
CAMERA = {"w": Number(1, 65536), "h": Number(1, 65536), **dict.fromkeys(("fl_x", "fl_y"), Number(0, above=True))}
CAMERA |= {"cx": Number(), "cy": Number()}
"""Intrinsics that every image needs, and their values."""
MODELS = {name: kind for name, kind in CAMERA_MODEL_TO_TYPE.items() if not name.startswith(("OMNI", "VR180"))}
"""Camera models; the others are for rendering alone: nerfstudio makes no rays of their single pixels."""
RADIAL = ("k1", "k2", "k3", "k4")
STRETCH = 10.0
"""Distortion that displaces a point half way to a corner by more than this factor is a mistake."""


def check_transforms(parser: NerfstudioDataParserConfig, data: Path, *, opens: bool) -> None:
    """Reads a transforms.json (in a folder, or a file of another name) and checks frames, poses and cameras.

    Where it ``opens`` images, it takes its downscale factor from the first, unless one is given, or from its copies.
    Raises InputError: one sentence with the file, the frame if it is of one, and what to do.
    """
    path = data if data.suffix == ".json" else data / "transforms.json"
    meta, frames = _read(path)
    poses = np.stack([_pose(frame, path) for frame in frames])
    check_lenses(meta, frames, path)
    first, factor = path.parent / frames[0]["file_path"], parser.downscale_factor
    if opens and factor is not None:
        if not Number(1, 1024, whole=True).holds(factor):
            raise InputError(f"--downscale-factor must be a whole number of at least 1, not {factor}.")
        copy = path.parent / f"images_{factor}" / first.name
        if factor > 1 and not copy.is_file():
            copies = sorted(folder.name for folder in path.parent.glob("images_*") if folder.is_dir())
            raise InputError(
                f"There is no {copy}, a copy at 1/{factor} of its size: make copies (mmpi-prepare does) or give "
                f"another --downscale-factor (there are {', '.join(copies) or 'no copies'})."
            )
    elif opens:
        with opened(first):
            pass
    names = [frame["file_path"] for frame in frames]
    check_places(poses[:, :3, 3], names, path, "nerfstudio-data", auto_scale=parser.auto_scale_poses)


@cache
def log_once(text: str) -> None:
    """Prints a note once."""
    CONSOLE.print(text)


def colmap_models(folder: Path) -> list[str]:
    """Usual folders of COLMAP models that exist below a folder."""
    return [
        place
        for place in ("colmap/sparse/0", "sparse/0", "sparse", "colmap/sparse", "dense/sparse")
        if any((folder / place / f"cameras.{ending}").is_file() for ending in ("bin", "txt"))
    ]


def _read(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    if not path.is_file():
        model = next(iter(colmap_models(path.parent)), "colmap/sparse/0")
        parser = "colmap" if model == "colmap/sparse/0" else f"colmap --colmap-path {model}"
        parser = "blender-data" if (path.parent / "transforms_train.json").is_file() else parser
        raise InputError(
            f"There is no {looked_at(path)}: check --data, make one with mmpi-prepare, or name the data parser of "
            f"another format after the options (for example: ns-train mmpi --data FOLDER {parser})."
        )
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON ({brief(error)}): repair it or make it again.") from error
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise InputError(f"{path} lists no frames: it needs 'frames', each with file_path and transform_matrix.")
    for i, frame in enumerate(frames):
        for key in ("file_path", "transform_matrix"):
            if key not in frame:
                name = cut(str(frame.get("file_path", f"number {i + 1}")))
                raise InputError(f"Frame {name} of {path} has no {key}: add it or remove the frame.")
        check_text(f"The file_path of frame number {i + 1} of {path}", frame["file_path"])
    return meta, frames


def _pose(frame: Mapping[str, Any], path: Path) -> NDArray[np.float64]:
    """The 4 x 4 matrix of a frame: a rotation and a translation."""
    try:
        pose = np.array(frame["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    wrong = None
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        wrong = "not a 4 x 4 matrix of finite numbers"
    elif np.abs((sizes := np.linalg.svd(pose[:3, :3], compute_uv=False)) - 1).max() > ROTATION_SLACK:
        wrong = f"no rotation and translation (its axes have singular values {', '.join(f'{s:.3g}' for s in sizes)})"
    elif np.linalg.det(pose[:3, :3]) < 0:
        wrong = "mirrored (its determinant is negative)"
    elif np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        wrong = f"no pose (its last row is {as_text(pose[3].tolist())} and not 0, 0, 0, 1), transposed perhaps"
    if wrong is not None:
        raise InputError(
            f"The transform_matrix of frame {cut(frame['file_path'])} of {path} is {wrong}: give camera to world with "
            "OpenGL axes, or remove the frame."
        )
    return pose


def check_places(
    centers: NDArray[np.float64], names: Sequence[str], path: Path, parser: str, *, auto_scale: bool
) -> None:
    """Raises InputError unless camera positions [M, 3] in a file or model differ, if the parser, by its name on the
    command line, divides by their extent, and none is far from all others."""
    if np.ptp(centers, axis=0).max() <= FLOAT64_SAME * max(1.0, np.abs(centers).max()):
        if not auto_scale:
            return
        raise InputError(
            f"All {len(centers)} camera(s) of {path} stand in one place, so no distance can be learned: give images "
            f"from two places, or learn colours alone ({parser} --auto-scale-poses False)."
        )
    extent = float(np.ptp(centers, axis=0).max())
    if np.abs(centers).max() > MAP_COORDINATES * max(extent, FLOAT64_SAME):
        raise InputError(
            f"The cameras of {path} stand {np.abs(centers).max():.3g} from the origin and within {extent:.3g} of each "
            "other, as in map coordinates, which lose their digits in 32 bits: mmpi-prepare IMAGES SCENE --poses "
            f"{path} writes a scene with an origin among the cameras."
        )
    off = np.linalg.norm(centers - np.median(centers, axis=0), axis=-1)
    count, last = len(off), int(off.argmax())
    usual = np.sort(off)[min(count - 1 - int(FEW * count), count - 2)]
    if usual > 0 and off[last] > FAR_OFF * usual:
        raise InputError(
            f"The camera of frame {cut(names[last])} of {path} stands {off[last]:.3g} from the others, which "
            f"lie within {usual:.3g}: correct its pose or remove the frame."
        )


def check_lenses(meta: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Checks the intrinsics of every camera; as in nerfstudio, a value for all frames overrides that of a frame."""
    model = meta.get("camera_model", "OPENCV")
    if not isinstance(model, str) or model not in MODELS:
        raise InputError(f"The camera_model of {path} is {as_text(model)}: give one of {', '.join(MODELS)}.")
    kind = MODELS[model]
    if meta.get("fisheye_crop_radius") is not None and "FISHEYE" in kind.name:
        log_once(f"The fisheye_crop_radius of {path} is not used: mask what lies outside it (mask_path).")
    if meta.get("is_fisheye") is True and kind != CameraType.FISHEYE:
        raise InputError(
            f"{path} is of instant-ngp (is_fisheye): name its data parser after the options (ns-train mmpi "
            "--data FOLDER instant-ngp-data), or write the camera_model OPENCV_FISHEYE."
        )
    # With one coefficient for all frames nerfstudio reads none of a frame.
    is_shared = any(key in meta for key in ("k1", "k2", "k3", "p1", "p2"))
    for frame in frames:
        camera, where = {key: meta.get(key, frame.get(key)) for key in CAMERA}, f"{cut(frame['file_path'])} in {path}"
        lacking = next((key for key in CAMERA if key not in meta and key not in frame), None)
        if lacking is not None:
            of_ngp = ", or name the data parser instant-ngp-data after the options" if "camera_angle_x" in meta else ""
            raise InputError(f"{path} has no {lacking}, neither for all frames nor in {where}: add it{of_ngp}.")
        _check_camera(camera, [(meta if is_shared else frame).get(key, 0) for key in RADIAL], kind, where)


def _check_camera(camera: Mapping[str, Any], radial: Sequence[Any], kind: CameraType, where: str) -> None:
    for key, values in CAMERA.items():
        check_number(f"The {key} of {where}", camera[key], values)
    for key, focal, center in (("w", "fl_x", "cx"), ("h", "fl_y", "cy")):
        size, (least, most) = camera[key], FOCAL_SHARES
        if size != int(size):
            raise InputError(f"The {key} of {where} must be whole pixels, not {as_text(size)}.")
        least = WHOLE_SPHERE[focal] if kind == CameraType.EQUIRECTANGULAR else least
        if kind != CameraType.ORTHOPHOTO and not 0.99 * least <= camera[focal] / size <= most:
            raise InputError(
                f"The focal length {focal} of {where} is {camera[focal]:g} pixels in an image of {size:g}: give it in "
                f"pixels, between {least:g} and {most:g} times the image's side."
            )
        if not 0 <= camera[center] <= size:
            raise InputError(
                f"The principal point {center} of {where} is {camera[center]:g}, outside the image of {size:g} "
                "pixels: give cx, cy, w and h for images of one size."
            )
    if kind not in (CameraType.PERSPECTIVE, CameraType.FISHEYE):
        return
    for key, value in zip(RADIAL, radial, strict=True):
        check_number(f"The distortion {key} of {where}", value, Number())
    # The radial polynomial must rise until it reaches a pixel half way to a corner (a tangent, or a fisheye's angle).
    radius = 0.25 * math.hypot(camera["w"] / camera["fl_x"], camera["h"] / camera["fl_y"])
    r = radius * np.linspace(0, STRETCH, 2001)
    with np.errstate(over="ignore", invalid="ignore"):
        distorted = r + sum(float(k) * r ** (2 * n + 3) for n, k in enumerate(radial))
        first = int(np.argmax(~(distorted < radius)))  # 0: never
        rises = bool((np.diff(distorted[: first + 1]) > 0).all())
    if first == 0 or not rises or r[first] < radius / STRETCH:
        said = ", ".join(f"{k} {x:g}" for k, x in zip(RADIAL, radial, strict=True) if x)
        raise InputError(
            f"The distortion of {where} ({said}) cannot be undone half way to the image's corners: give OpenCV's "
            "coefficients for this camera_model, or undistorted images without any."
        )
