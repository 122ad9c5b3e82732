"""Checks of the input before nerfstudio reads it, whose errors name neither frame nor remedy."""

from __future__ import annotations

import json
import math
import os
import re
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
from mmpi_ns.utils.values import Number, as_text, check_number, check_row, cut

FLOAT64_SAME = 1e-12
"""Cameras of a file closer together than this fraction of their distance from the origin count as one place."""
ROTATION_SLACK = 0.01
"""Tolerance on the length of the axes of a pose, which should be 1."""
MAP_COORDINATES = 2000.0
"""Distance of the cameras from the origin, relative to their extent, above which float32 cannot represent their
positions."""
FAR_OFF, FEW = 1000.0, 0.1
"""A camera this many times as far away as all but a few others, this fraction of them, is a mistake."""
SPLITS = ("train_filenames", "val_filenames", "test_filenames")
PATHS = ("file_path", "mask_path", "depth_file_path")
NO_PATH = "[\0\ud800-\udfff]"
"""Invalid in a path: NUL, and lone surrogates, which also stand for bytes of a file name that are not UTF-8."""
PARSER_OPTIONS = {
    "scale_factor": Number(0, 1e9, above=True),
    "scene_scale": Number(0, above=True),
    "train_split_fraction": Number(0, 1, above=True),
    "eval_interval": Number(1, whole=True),
    "depth_unit_scale_factor": Number(0, above=True),
}
"""Options that nerfstudio's data parsers have."""
ORIENTATIONS = ("pca", "up", "vertical", "none")

Frames = Sequence[Mapping[str, Any]]
POSITIVE = Number(0, above=True)
SIDE = Number(1, 65536)
"""Pixels along a side of an image."""
FOCAL_SHARES = (1e-3, 1e4)
"""Plausible focal lengths, in widths of the image."""
WHOLE_SPHERE = {"fl_x": 0.5, "fl_y": 1.0}
"""Minimum focal lengths of an equirectangular image, in sides of the image; smaller ones would repeat it."""
MODELS = {
    name: kind for name, kind in CAMERA_MODEL_TO_TYPE.items() if not name.startswith(("OMNIDIRECTIONALSTEREO", "VR180"))
}
"""Names of camera models; those of image pairs have no pose per image."""
LONG_LENS = 12
"""Number of coefficients of a FISHEYE624 in nerfstudio."""
CAMERA = ("fl_x", "fl_y", "cx", "cy", "w", "h")
RADIAL, TANGENTIAL = ("k1", "k2", "k3", "k4"), ("p1", "p2")
STRETCH = 10.0
"""Distortion that displaces a point half way to a corner by more than this factor is a mistake."""


def check_transforms(parser: NerfstudioDataParserConfig, data: Path, splits: Sequence[str], *, opens: bool) -> None:
    """Reads a transforms.json (in a folder, or a file of another name) and checks everything that nerfstudio's parser
    takes from it, for the ``splits`` of train, val and test that will be requested.

    Where it ``opens`` images, it takes its downscale factor from the first, unless one is given, or from its copies.
    Raises InputError: one sentence with the file, the frame if it is of one, and what to do.
    """
    path = data if data.suffix == ".json" else data / "transforms.json"
    meta, frames = _read(path)
    _check_files(parser, meta, frames, path)
    poses = np.stack([_pose(frame, path) for frame in frames])
    _check_whole_file(meta, frames, splits, path, by_name=(parser.downscale_factor or 1) > 1)
    check_lenses(meta, frames, path)
    first, factor = path.parent / frames[0]["file_path"], parser.downscale_factor
    if opens and factor is not None:
        if not Number(1, 1024, whole=True).holds(factor):
            raise InputError(f"--downscale-factor must be a whole number of at least 1, not {factor}.")
        copy = path.parent / f"images_{factor}" / first.name
        if factor > 1 and not copy.is_file():
            raise InputError(
                f"There is no {copy}, a copy at 1/{factor} of its size: make copies (mmpi-prepare does) or give "
                f"another --downscale-factor (there are {names_of_copies(path.parent)})."
            )
    elif opens:
        with opened(first):
            pass
    names = [str(frame["file_path"]) for frame in frames]
    check_places(poses[:, :3, 3], names, path, "nerfstudio-data", auto_scale=parser.auto_scale_poses)
    files = [str(frame[key]) for frame in frames for key in PATHS if key in frame]
    folder = os.path.realpath(path.parent)
    outside = [n for n in files if not Path(os.path.realpath(path.parent / n)).is_relative_to(folder)]
    if outside:
        log_once(f"{len(outside)} file(s) of {path} lie outside its folder, for example {cut(outside[0])}.")


def names_of_copies(folder: Path) -> str:
    """Names of a capture's folders of downscaled copies, as text."""
    return ", ".join(sorted(p.name for p in folder.glob("images_*") if p.is_dir())) or "no copies"


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
    return meta, frames


def _check_files(parser: NerfstudioDataParserConfig, meta: Mapping[str, Any], frames: Frames, path: Path) -> None:
    """Fields of each frame that must be there, and its paths: text, and in all frames or none."""
    for i, frame in enumerate(frames):
        for key in ("file_path", "transform_matrix"):
            if key not in frame:
                name = cut(str(frame.get("file_path", f"number {i + 1}")))
                raise InputError(f"Frame {name} of {path} has no {key}: add it or remove the frame.")
        for key in PATHS:
            value = frame.get(key, "given")
            if not isinstance(value, str) or not value.strip() or re.search(NO_PATH, value):
                raise InputError(
                    f"The {key} of frame number {i + 1} of {path} is {as_text(value)}: give the path of a file as text "
                    "(UTF-8)."
                )
            if "\\" in value and not (path.parent / value).is_file():
                raise InputError(
                    f"The {key} {cut(value)} of {path} has back slashes and is no file here: write / instead of them."
                )
    for key in ("mask_path", "depth_file_path"):
        bare = next((f for f in frames if key not in f), None)
        if bare is not None and any(key in f for f in frames):
            raise InputError(
                f"Frame {cut(bare['file_path'])} of {path} has no {key} and others have one: give all frames one, or "
                "none."
            )
    names = [] if any(key in meta for key in SPLITS) else [frame["file_path"] for frame in frames]
    for name in names if parser.eval_mode == "filename" else ():
        if not re.search("train|eval", Path(name).name):
            raise InputError(
                f"The file name of frame {cut(name)} of {path} has neither train nor eval in it: rename it, or give "
                "another --eval-mode."
            )


def _pose(frame: Mapping[str, Any], path: Path) -> NDArray[np.float64]:
    """The 4 x 4 matrix of a frame: a rotation and a translation."""
    name, rows = cut(frame["file_path"]), frame["transform_matrix"]
    number = Number(-1e18, 1e18)
    is_matrix = isinstance(rows, list) and len(rows) == 4 and all(isinstance(r, list) and len(r) == 4 for r in rows)
    if not is_matrix or not all(number.holds(x) for row in rows for x in row):
        raise InputError(
            f"The transform_matrix of frame {name} of {path} is not a 4 x 4 matrix of finite numbers: correct it or "
            "remove the frame."
        )
    pose = np.array(rows, dtype=np.float64)
    sizes = np.linalg.svd(pose[:3, :3], compute_uv=False)
    wrong = None
    if np.abs(sizes - 1).max() > ROTATION_SLACK:
        wrong = f"no rotation and translation (its axes have singular values {', '.join(f'{s:.3g}' for s in sizes)})"
    elif np.linalg.det(pose[:3, :3]) < 0:
        wrong = "mirrored (its determinant is negative)"
    elif np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        wrong = f"no pose (its last row is {as_text(rows[3])} and not 0, 0, 0, 1), transposed perhaps"
    if wrong is not None:
        raise InputError(
            f"The transform_matrix of frame {name} of {path} is {wrong}: give camera to world with OpenGL axes, or "
            "remove the frame."
        )
    return pose


def _check_whole_file(
    meta: Mapping[str, Any], frames: Frames, splits: Sequence[str], path: Path, *, by_name: bool
) -> None:
    """Fields that hold for all frames, and lists of training and evaluation frames: if there is any, all requested
    splits need theirs."""
    if "applied_transform" in meta:
        rows = meta["applied_transform"]
        if not isinstance(rows, list) or len(rows) != 3:
            raise InputError(f"applied_transform of {path} must be 3 rows of 4 numbers, not {as_text(rows)}.")
        for i, row in enumerate(rows):
            check_row(f"Row {i + 1} of applied_transform of {path}", row, 4, Number(-1e18, 1e18))
        if abs(np.linalg.det(np.array(rows, dtype=np.float64)[:, :3])) < 1e-12:
            raise InputError(f"applied_transform of {path} is singular: give a rotation and a translation.")
    for key, most in (("applied_scale", 1e18), ("fisheye_crop_radius", 1e6)):
        if key in meta:
            check_number(f"{key} of {path}", meta[key], Number(0, most, above=True))
    cloud = meta.get("ply_file_path", "given")
    if not isinstance(cloud, str):
        raise InputError(f"ply_file_path of {path} is {as_text(cloud)}: give the path of a PLY file, or leave it out.")
    turned = meta.get("orientation_override", "none")
    if turned not in ORIENTATIONS:
        raise InputError(
            f"orientation_override of {path} is {as_text(turned)}: leave it out or give one of "
            f"{', '.join(ORIENTATIONS)}."
        )
    kind = (lambda name: Path(name).name) if by_name else Path
    names = {kind(frame["file_path"]) for frame in frames}
    has_lists = any(key in meta for key in SPLITS)
    for key in dict.fromkeys(f"{split}_filenames" for split in splits) if has_lists else ():
        listed = meta.get(key)
        if not isinstance(listed, list) or not listed or not all(isinstance(x, str) for x in listed):
            others = ", ".join(k for k in SPLITS if k in meta and k != key) or "one of them"
            raise InputError(
                f"{path} has {others} and {'no list ' if listed is None else 'an unusable '}{key}: list the file_path "
                "of every frame in it, or remove the three lists."
            )
        lost = [x for x in listed if kind(x) not in names]
        if lost:
            raise InputError(
                f"{as_text(lost[0])}, listed in {key} of {path}, is the file_path of no frame ({len(lost)} such in "
                "all): correct the list."
            )


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
    other = next((f for f in frames if MODELS.get(str(f.get("camera_model", model))) != MODELS[model]), None)
    if other is not None:
        raise InputError(
            f"Frame {cut(other['file_path'])} of {path} has the camera_model {as_text(other['camera_model'])}, and one "
            f"for the whole file is used ({model}): state it there, and remove frames of other models."
        )
    if meta.get("is_fisheye") is True and MODELS[model] != CameraType.FISHEYE:
        raise InputError(
            f"{path} is of instant-ngp (is_fisheye): name its data parser after the options (ns-train mmpi "
            "--data FOLDER instant-ngp-data), or write the camera_model OPENCV_FISHEYE."
        )
    for key in CAMERA:
        lacking = next((f for f in frames if key not in f), None) if key not in meta else None
        if lacking is not None and "camera_angle_x" in meta:
            raise InputError(
                f"{path} has camera_angle_x and no {key}: name the data parser of instant-ngp after the options "
                f"(ns-train mmpi --data FOLDER instant-ngp-data), or add {key}."
            )
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
            raise InputError(f"The {key} of {where} must be whole pixels, not {as_text(camera[key])}.")
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
