"""Initial cameras of SfM, and given poses: KITTI, TUM, transforms.json, 4x4 text files, matched with the
images."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap

from mmpi_ns.data.checks import MAP_COORDINATES
from mmpi_ns.utils.errors import InputError, log
from mmpi_ns.utils.files import natural_key
from mmpi_prepare.adjustment import Array, camera_poses, nearest_rotation
from mmpi_prepare.images import IMAGES, Photo
from mmpi_priors.conventions import Matches, find_convention, in_words

Lens = Literal["auto", "pinhole", "radial", "opencv", "fisheye"]
Sharing = Literal["auto", "shared", "per-image"]
MODELS = {"pinhole": "PINHOLE", "radial": "SIMPLE_RADIAL", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
GUESSED_FOCAL = 1.2
"""Focal length over the longer side without other information: COLMAP's guess."""
GIVEN_COUNTS = {3: "f cx cy", 4: "fx fy cx cy", 8: "fx fy cx cy k1 k2 p1 p2"}
MAX_LAG = 0.05
"""Maximum time in seconds between an image and its pose."""
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
KIND = re.compile(r"[._-]?(pose|color|rgb|image|depth)s?$", re.IGNORECASE)
"""End of a name that differs between images, poses and depths: frame-000001.color.png, frame-000001.pose.txt."""


def opencv_camera(values: Sequence[float], fisheye: bool) -> pycolmap.Camera:
    """A camera of no size by fx, fy, cx, cy and the terms of its lens, k1, k2, p1, p2, k3 or k1 to k4 of a fisheye; a
    pinhole where there are none."""
    bent = "FULL_OPENCV" if any(values[8:]) else "OPENCV" if any(values[4:]) else "PINHOLE"
    model, sizes = "OPENCV_FISHEYE" if fisheye else bent, {"PINHOLE": 4, "FULL_OPENCV": 12}
    return pycolmap.Camera(model=model, params=[*values, *[0.0] * 8][: sizes.get(model, 8)])


def make_cameras(
    photos: Sequence[Photo], sharing: Sharing, lenses: dict[str, pycolmap.Camera], focal: float | None, lens: Lens
) -> tuple[list[int], list[pycolmap.Camera]]:
    """Cameras from given intrinsics (``lenses`` by image name, ``focal`` in pixels), else from EXIF, else guessed;
    images of one size, lens and given intrinsics share one, unless ``sharing`` is set otherwise.

    Returns the camera of each image, numbered from 1, and the cameras in this order. Raises InputError if images of
    different sizes are to share one.
    """
    sizes = {(p.width, p.height) for p in photos}
    if sharing == "shared" and len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise InputError(f"--intrinsics shared, but the images are of different sizes ({listed}): use auto.")
    by_key: dict[Any, int] = {}
    numbers: list[int] = []
    cameras: list[pycolmap.Camera] = []
    for photo in photos:
        known = lenses.get(photo.name)
        given = known and (known.model.name, *known.params)
        key = (photo.width, photo.height, "" if sharing == "shared" else photo.lens, given)
        number = by_key.setdefault(photo.name if sharing == "per-image" else key, len(cameras) + 1)
        numbers.append(number)
        if number <= len(cameras):
            continue
        if known is not None:
            size = {"width": photo.width, "height": photo.height, "camera_id": number}
            camera = pycolmap.Camera(model=known.model, params=known.params, **size)
        else:
            model = MODELS["radial" if lens == "auto" and focal is None else "pinhole" if lens == "auto" else lens]
            guess = focal or photo.exif_focal or GUESSED_FOCAL * max(photo.width, photo.height)
            camera = pycolmap.Camera.create_from_model_name(number, model, guess, photo.width, photo.height)
        camera.has_prior_focal_length = bool(known or focal or photo.exif_focal)
        cameras.append(camera)
    return numbers, cameras


def opencv_intrinsics(camera: pycolmap.Camera) -> tuple[list[float], bool]:
    """The numbers of ``opencv_camera``, nine of them, and whether it is a fisheye. Raises InputError if
    nerfstudio-data does not support the lens model."""
    name, terms = camera.model.name, [float(v) for v in camera.params[camera.extra_params_idxs()]]
    if name not in (*MODELS.values(), "SIMPLE_PINHOLE", "RADIAL", "FULL_OPENCV") or any(terms[5:]):
        raise InputError(f"Lens model {name} is not supported in transforms.json.")
    f = (camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y)
    return [*f, *terms, *[0.0] * 5][:9], name == "OPENCV_FISHEYE"


@dataclass(frozen=True)
class GivenPoses:
    """Poses by image name."""

    poses: dict[str, Array]
    """Camera to world, OpenCV axes (x right, y down, z forward). [4, 4]"""
    summary: str
    """Format and how images were matched, in words."""
    intrinsics: dict[str, pycolmap.Camera] = field(default_factory=dict)
    """Intrinsics of the same images, from a transforms.json."""
    split: dict[str, Any] | None = None
    """A transforms.json's lists of files, by the names of the images."""
    axes: Array = field(default_factory=lambda: np.eye(3))
    """The axes that the file's matrices are taken to have, as in ``conventions.py``."""


def read_poses(path: Path, axes: str, photos: Sequence[Photo]) -> GivenPoses:
    """Reads given poses, a file or a folder of 4x4 text files, and matches them with the images. Raises InputError if
    they cannot be read, or fit fewer than two images."""
    is_transforms = path.suffix.lower() == ".json"
    if is_transforms or not path.is_dir():
        read = (_read_transforms if is_transforms else _read_lines)(path, photos)
    else:  # one text file for each image, by name, else in order
        files = [p for p in path.glob("[!.]*") if p.suffix.lower() in (".txt", ".mat", "")]
        files.sort(key=lambda p: natural_key(p.name))
        by_stem = {KIND.sub("", p.stem): p for p in files if p.is_file()}
        chosen = {p.name: by_stem[stem] for p in photos if (stem := KIND.sub("", Path(p.source).stem)) in by_stem}
        summary = "4x4 matrices, by name"
        if len(chosen) < 2:
            if len(files) != len(photos):
                raise InputError(f"{path} has {len(files)} files for {len(photos)} images, and the names do not match.")
            chosen, summary = {p.name: f for p, f in zip(photos, files, strict=True)}, "4x4 matrices, in order"
        _check_apart(chosen, path)
        poses = {}
        for name, file in chosen.items():
            matrix = _read_numbers(file)
            if matrix.shape not in ((4, 4), (3, 4)):
                raise InputError(f"{file} is {matrix.shape}, not 4x4.")
            poses[name] = np.vstack([matrix[:3], [0.0, 0.0, 0.0, 1.0]])
        read = GivenPoses(poses, summary)
    opengl = axes == "opengl" or (axes == "auto" and is_transforms)
    flip = np.diag([1.0, -1.0, -1.0, 1.0]) if opengl else np.eye(4)
    poses = {n: p @ flip for n, p in read.poses.items() if np.isfinite(p).all()}
    for name, pose in poses.items():
        stretch = np.linalg.svd(pose[:3, :3])[1]
        if np.abs(stretch - 1).max() > 0.02 or np.linalg.det(pose[:3, :3]) < 0:
            raise InputError(f"The pose of {name} is no rotation and translation (singular values {stretch.round(3)}).")
        pose[:3, :3] = nearest_rotation(pose[:3, :3])
    if len(poses) < 2:
        raise InputError(f"--poses {path} has finite poses for {len(poses)} images: at least two are needed.")
    if len(poses) < len(photos):
        log(f"{len(photos) - len(poses)} of {len(photos)} images have no pose: left out.", "yellow")
    centers = np.array([pose[:3, 3] for pose in poses.values()])
    extent = np.ptp(centers, axis=0).max()
    if extent > 0 and np.abs(centers).max() > min(MAP_COORDINATES * extent, 1e5):  # float32 rounds 1e5 to 0.01
        origin = np.round(centers.mean(0))
        for pose in poses.values():
            pose[:3, 3] -= origin
        place = ", ".join(f"{x:.10g}" for x in origin)
        read = replace(read, summary=f"{read.summary}, in map coordinates, of which ({place}) is subtracted")
    return replace(read, poses=poses, axes=flip[:3, :3])


def agreeing(known: GivenPoses, model: pycolmap.Reconstruction, database: Path) -> GivenPoses:
    """The poses, read in the convention that explains the verified matches of a database, if theirs does not.

    ``model`` has the poses and cameras. Raises InputError if these contradict the matches for another reason."""
    names, poses = camera_poses(model)
    matrices, cameras = poses.copy(), [model.cameras[image.camera_id] for _, image in sorted(model.images.items())]
    matrices[:, :3, :3] = poses[:, :3, :3] @ known.axes
    focals = np.array([[c.focal_length_x, c.focal_length_y] for c in cameras])
    widths, centers = (np.array([getattr(c, k) for c in cameras], float) for k in ("width", "principal_point_x"))
    centers = np.stack([centers, [c.principal_point_y for c in cameras]], -1)
    lens = focals[:, 0] / widths, focals, centers
    as_given, better, is_wrong = find_convention(matrices, known.axes, lens, Matches.of(model, database))
    if better is None:
        return known
    summary = in_words(better, known.axes, float(focals[0, 0]), float(widths.mean()), as_given.error)
    if better.focal != 1.0 or better.bend is not None:
        if is_wrong:
            raise InputError(f"The intrinsics contradict the images. {summary} Give --focal or --camera.")
        return known
    log(summary, "yellow")
    return replace(
        known, poses=dict(zip(names, better.applied(matrices), strict=True)), summary=f"{known.summary}. {summary}"
    )


def _read_numbers(file: Path) -> Array:
    """The lines of a text file, in which # begins a comment. [lines, numbers]"""
    text = file.read_text(encoding="utf-8", errors="replace").replace(",", " ")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a file without numbers
            return np.loadtxt(text.splitlines(), dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise InputError(f"{file} cannot be read ({error}).") from error


def _read_lines(path: Path, photos: Sequence[Photo]) -> GivenPoses:
    """Poses in the lines of a text file, in which # begins a comment.

    KITTI: 12 numbers, a line for each image; of more lines, the numbers in the file names choose (counted from 0). TUM:
    8 numbers, by time stamp if the file names are time stamps, else a line for each image. Whole numbers in names are
    time stamps if those of the file are whole, too, unless there is a line for each image and some have none.
    """
    numbers = _read_numbers(path)
    rows, width = numbers.shape
    if width not in (8, 12):
        formats = "KITTI has 12 numbers a line, TUM 8 (time, position, quaternion x y z w)"
        raise InputError(f"--poses {path} is not understood: {formats}.")
    poses = np.tile(np.eye(4), (rows, 1, 1))
    places, summary = list(range(len(photos))), "one line for each image"
    if width == 12:
        poses[:, :3] = numbers.reshape(-1, 3, 4)
        if rows != len(photos):
            digits = [re.findall(r"\d+", Path(p.source).stem) for p in photos]
            places = [int(d[-1]) for d in digits if d]
            first = int(bool(places) and max(places) == rows)
            places = [place - first for place in places]
            if len(set(places)) < len(photos) or not 0 <= min(places) <= max(places) < rows:
                raise InputError(f"{path} has {rows} poses for {len(photos)} images: they cannot be matched.")
            summary = f"the lines that the images' numbers name (from {first})"
        return GivenPoses({p.name: poses[i] for p, i in zip(photos, places, strict=True)}, f"KITTI poses, {summary}")
    for pose, row in zip(poses, numbers, strict=True):
        pose[:3, :3] = pycolmap.Rotation3d(row[4:8]).matrix() if np.linalg.norm(row[4:8]) > 0 else np.nan
        pose[:3, 3] = row[1:4]
    matched: dict[str, Array] = {}
    are_whole = not (numbers[:, 0] % 1).any()
    pattern = r"\d+\.\d+" + are_whole * r"|\d+"
    for photo in photos:
        source = Path(photo.source)
        stamps = re.findall(pattern, source.stem if source.suffix.lower() in IMAGES else photo.source)
        lags = np.abs(numbers[:, 0] - float(stamps[-1])) if stamps else np.full(1, np.inf)
        if lags.min() <= MAX_LAG:
            matched[photo.name] = poses[lags.argmin()]
    if 2 * len(matched) >= len(photos) and not (are_whole and len(matched) < len(photos) == rows):
        return GivenPoses(matched, f"TUM poses, matched by time stamp within {MAX_LAG} s")
    if rows != len(photos):
        raise InputError(
            f"{path} has {rows} poses for {len(photos)} images, and the images' names are not their time stamps."
        )
    return GivenPoses({p.name: pose for p, pose in zip(photos, poses, strict=True)}, f"TUM poses, {summary}")


def _read_transforms(path: Path, photos: Sequence[Photo]) -> GivenPoses:
    """Poses of a transforms.json by file name, with its intrinsics and its lists of train and test files, if any."""
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
        frames: list[dict[str, Any]] = meta["frames"]
        files = [Path(f["file_path"]) for f in frames]
        places = {}  # the frame with an image's name, and its folder if several have that name
        for photo in photos:
            for name in (Path(photo.name), Path(photo.source)):
                named = [n for n, f in enumerate(files) if f.stem == name.stem]
                folders = name.parent.parts
                inside = [n for n in named if files[n].parent.parts[-len(folders) :] == folders] if folders else []
                if len(named) == 1 or len(inside) == 1:
                    places[photo.name] = (inside or named)[0]
                    break
        _check_apart(places, path)
        poses, intrinsics = {}, {}
        for photo in (p for p in photos if p.name in places):
            frame = frames[places[photo.name]] | meta  # as in nerfstudio, a value for all overrides that of a frame
            frame |= zip(("k1", "k2", "k3", "k4", "p1", "p2"), frame.get("distortion_params", ()), strict=False)
            poses[photo.name] = np.array(frame["transform_matrix"], dtype=np.float64).reshape(4, 4)
            if "fl_x" in frame:  # for images that may be smaller or larger than those of the file
                fisheye = frame.get("camera_model") in FISHEYE
                keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
                if not fisheye and frame.get("k4"):
                    raise InputError(f"{path} gives {photo.name} a k4, which OpenCV's perspective lens lacks.")
                sx, sy = photo.width / frame.get("w", photo.width), photo.height / frame.get("h", photo.height)
                if abs(sx / sy - 1) > 0.02:
                    raise InputError(f"{photo.name} is {photo.width}x{photo.height}, transforms.json says otherwise.")
                fx, fy = float(frame["fl_x"]), float(frame.get("fl_y", frame["fl_x"]))
                cx, cy = float(frame.get("cx", photo.width / sx / 2)), float(frame.get("cy", photo.height / sy / 2))
                values = (fx * sx, fy * sy, cx * sx, cy * sy, *(float(frame.get(k, 0.0)) for k in keys))
                intrinsics[photo.name] = opencv_camera(values, fisheye)
        if intrinsics and (without := [name for name in poses if name not in intrinsics]):
            raise InputError(f"{path} gives {without[0]} no fl_x, as it gives other images.")
        lists, named = ("train_filenames", "test_filenames"), {files[n]: name for name, n in places.items()}
        is_split = all(key in meta for key in lists)
        split = {key: [named.get(Path(f), f) for f in meta[key]] for key in lists} if is_split else None
    except InputError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"--poses {path} is no transforms.json as nerfstudio writes it ({error!r}).") from error
    return GivenPoses(poses, "poses of a transforms.json, by name", intrinsics, split)


def _check_apart(poses: dict[str, Any], path: Path) -> None:
    """Raises InputError if two images were given the same pose, as images of two folders may have the same name."""
    first: dict[Any, str] = {}
    for name, pose in poses.items():
        if pose in first:
            raise InputError(
                f"{path} has one pose for {first[pose]} and {name}: images of one name in two folders need two."
            )
        first[pose] = name
