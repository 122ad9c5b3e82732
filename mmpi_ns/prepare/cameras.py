"""Cameras shared by images, and the intrinsics that SfM starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import pycolmap

from mmpi_ns.prepare.images import Photo
from mmpi_ns.prepare.stages import PrepareError

Lens = Literal["auto", "pinhole", "radial", "opencv", "fisheye"]
Sharing = Literal["auto", "shared", "per-image"]
MODELS = {"pinhole": "PINHOLE", "radial": "SIMPLE_RADIAL", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
GUESSED_FOCAL = 1.2
"""Focal length over the longer side if nothing is known: COLMAP's guess."""
GIVEN_COUNTS = {3: "f cx cy", 4: "fx fy cx cy", 8: "fx fy cx cy k1 k2 p1 p2"}


@dataclass(frozen=True)
class Intrinsics:
    """A lens in pixels of one image: OpenCV's pinhole and distortion, or OpenCV's fisheye."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2; k1 to k4 of a fisheye lens."""
    fisheye: bool = False


def parse_camera(values: Sequence[float], fisheye: bool) -> Intrinsics:
    """The camera of ``--camera``. Raises PrepareError if the numbers fit none or a focal length is not positive."""
    if len(values) not in GIVEN_COUNTS:
        raise PrepareError(f"--camera takes {' or '.join(GIVEN_COUNTS.values())}, not {len(values)} numbers.")
    if len(values) == 3:
        values = (values[0], *values)
    if min(values[:2]) <= 0:
        raise PrepareError("--camera: focal lengths must be positive, in pixels.")
    lens = tuple(values[4:]) or (0.0,) * 4
    return Intrinsics(*values[:4], distortion=lens, fisheye=fisheye)  # type: ignore[arg-type]


def share(photos: Sequence[Photo], sharing: Sharing, lenses: dict[str, Intrinsics]) -> list[int]:
    """Camera of each image, numbered from 1: images of one size, lens and given intrinsics share one. Raises
    PrepareError if images of different sizes are to share one camera."""
    if sharing == "per-image":
        return list(range(1, len(photos) + 1))
    sizes = {(p.width, p.height) for p in photos}
    if sharing == "shared" and len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise PrepareError(f"--intrinsics shared, but the images are of different sizes ({listed}): use auto.")
    numbers: dict[Any, int] = {}
    keys = [(p.width, p.height, "" if sharing == "shared" else p.lens, lenses.get(p.name)) for p in photos]
    return [numbers.setdefault(key, len(numbers) + 1) for key in keys]


def make_cameras(
    photos: Sequence[Photo], numbers: Sequence[int], lenses: dict[str, Intrinsics], focal: float | None, lens: Lens
) -> list[pycolmap.Camera]:
    """One pycolmap camera for each number, from given intrinsics, else from EXIF, else guessed.

    Args:
        photos: the images.
        numbers: camera of each image.
        lenses: known intrinsics by image name.
        focal: focal length in pixels, from the command line.
        lens: distortion model if none is given.
    """
    cameras: dict[int, pycolmap.Camera] = {}
    for photo, number in zip(photos, numbers, strict=True):
        if number in cameras:
            continue
        intrinsics = lenses.get(photo.name)
        if intrinsics is not None:
            params = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
            is_bent = intrinsics.fisheye or any(intrinsics.distortion)
            model = "OPENCV_FISHEYE" if intrinsics.fisheye else "OPENCV" if is_bent else "PINHOLE"
            params += intrinsics.distortion if is_bent else ()
            size = {"width": photo.width, "height": photo.height, "camera_id": number}
            cameras[number] = pycolmap.Camera(model=model, params=params, **size)
        else:
            model = MODELS["radial" if lens == "auto" and focal is None else "pinhole" if lens == "auto" else lens]
            guess = focal or photo.exif_focal or GUESSED_FOCAL * max(photo.width, photo.height)
            cameras[number] = pycolmap.Camera.create_from_model_name(number, model, guess, photo.width, photo.height)
        cameras[number].has_prior_focal_length = bool(intrinsics or focal or photo.exif_focal)
    return [cameras[n] for n in sorted(cameras)]


def read_intrinsics(camera: pycolmap.Camera) -> Intrinsics:
    """A pycolmap camera as OpenCV's. Raises PrepareError if nerfstudio-data does not support the lens model."""
    name, p = camera.model.name, [float(v) for v in camera.params]
    f = (camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y)
    terms = {"SIMPLE_PINHOLE": [], "PINHOLE": [], "SIMPLE_RADIAL": p[3:], "RADIAL": p[3:]}
    terms |= {"OPENCV": p[4:], "OPENCV_FISHEYE": p[4:]}
    if name not in terms:
        raise PrepareError(f"Lens model {name} is not supported in transforms.json.")
    k1, k2, k3, k4 = (*terms[name], 0.0, 0.0, 0.0, 0.0)[:4]
    return Intrinsics(*f, distortion=(k1, k2, k3, k4), fisheye=name == "OPENCV_FISHEYE")
