"""Depth images of an RGB-D camera: named like the images, compared with the model, and written as nerfstudio reads
them (``depth_file_path``, thousandths of a scene unit along the optical axis, 0 where unknown)."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from mmpi_ns.utils.errors import InputError, brief, log, progress
from mmpi_ns.utils.files import whole
from mmpi_prepare.images import Photo, in_short
from mmpi_prepare.poses import KIND

KINDS = (".png", ".npy")
SHAPE = 0.02
"""Maximum relative difference between the shapes (width over height) of an image and of its depth image: sizes of
sensors and colour cameras differ, but depths must be registered to the colours."""
THOUSAND = 1000.0
"""Values of a depth image for one scene unit: nerfstudio's ``depth_unit_scale_factor`` of 0.001."""
STAMP, LAG = re.compile(r"\d+\.\d+"), 0.02
"""Names of the files of TUM's RGB-D captures, in seconds, and the largest time between an image and its depths."""
TUM = 0.2
"""Millimetres of a value of a depth image there: a folder with depth.txt beside it."""
LEAST, SPREAD = 100, 0.1
"""Minimum number of SfM points with a depth, and maximum median difference of their depths from the model's: 0.01 to
0.03 for sensors, 0.3 for depths of other images and disparities."""


def find_depths(folder: Path, photos: Sequence[Photo]) -> dict[str, Path]:
    """The depth image of each photo, by name of the photo: a.png or a.npy for a.jpg, or frame-1.depth.png for
    frame-1.color.jpg; where names are time stamps, the nearest, and photos that none is near are left out. Raises
    InputError if one is missing, or most are not near, or one is no depth image, or has another shape."""
    files = [p.relative_to(folder) for p in sorted(folder.rglob("*")) if p.suffix.lower() in KINDS]
    often = Counter(_bare(p.name) for p in files)
    by_name = {_bare(p.name): p for p in files if often[_bare(p.name)] == 1} | {_bare(p): p for p in files}
    times = {float(name): p for name, p in by_name.items() if STAMP.fullmatch(name)}
    found: dict[str, Path] = {}
    for photo in photos:
        names = _bare(photo.source), _bare(Path(photo.source).name)  # with its folders, if several files have the name
        if name := next((n for n in names if n in by_name), None):
            found[photo.name] = folder / by_name[name]
        elif times and STAMP.fullmatch(names[1]):
            nearest = min(times, key=lambda time: abs(time - float(names[1])))
            found |= {photo.name: folder / times[nearest]} if abs(nearest - float(names[1])) <= LAG else {}
    missing = [p.name for p in photos if p.name not in found]
    if missing and times and len(found) > len(missing):
        log(f"{len(missing)} images have no depths within {LAG} s: left out ({in_short(missing)}).", "yellow")
    elif missing:
        raise InputError(
            f"--depths {folder} has no depth image for {len(missing)} of {len(photos)} images ({in_short(missing)}): "
            "give all of them one, named alike (a.png or a.npy for a.jpg)."
        )
    for photo in (p for p in photos if p.name in found):
        height, width = read_millimetres(found[photo.name]).shape
        if abs(width / height * photo.height / photo.width - 1) > SHAPE:
            raise InputError(
                f"Depth image {found[photo.name]} is {width}x{height}, its image {photo.name} "
                f"{photo.width}x{photo.height}: depths must be registered to the colours."
            )
    return found


def _bare(path: Path | str) -> str:
    return KIND.sub("", Path(path).with_suffix("").as_posix())


def _is_tum(file: Path) -> bool:
    return file.parent.with_name("depth.txt").is_file()


def read_millimetres(file: Path) -> NDArray[np.float32]:
    """Depths along the optical axis, millimetres [h, w]; 0 where unknown. Integers are millimetres, or TUM's
    units, other numbers metres. Raises InputError if a file is damaged, or is no depth image."""
    try:
        is_array = file.suffix.lower() == ".npy"
        depth = np.load(file) if is_array else cv2.imdecode(np.fromfile(file, np.uint8), cv2.IMREAD_UNCHANGED)
        depth = np.zeros(0) if depth is None else np.squeeze(depth)
    except (OSError, ValueError, EOFError, cv2.error) as error:
        raise InputError(f"Depth image {file} cannot be read ({brief(error)}): repair or remove it.") from error
    if depth.ndim != 2 or depth.dtype.kind not in "uif" or depth.dtype.itemsize < 2:
        raise InputError(f"Depth image {file} is not one channel of depths: give a 16-bit PNG or a .npy file.")
    depth = depth.astype(np.float32) * np.float32(THOUSAND if depth.dtype.kind == "f" else TUM if _is_tum(file) else 1)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0)


def metres_of(model: pycolmap.Reconstruction, files: Mapping[str, Path]) -> tuple[float, str]:
    """Metres per unit of a model by the depths at its points (the median ratio), and their agreement in words.

    Raises InputError if they contradict the model.
    """
    ratios: list[NDArray[np.float64]] = [np.zeros(0)]
    with progress("Comparing depths", model.num_reg_images()) as advance:
        for number in sorted(model.reg_image_ids()):
            image, depth = model.images[number], read_millimetres(files[model.images[number].name])
            size = [model.cameras[image.camera_id].width, model.cameras[image.camera_id].height]
            seen = [p for p in image.points2D if p.has_point3D()]
            places = np.array([p.xy for p in seen]).reshape(-1, 2) / size * depth.shape[::-1]
            x, y = np.clip(places.astype(int), 0, np.array(depth.shape[::-1]) - 1).T
            points = np.array([model.points3D[p.point3D_id].xyz for p in seen]).reshape(-1, 3)
            z = np.asarray(image.cam_from_world().matrix())[2] @ np.c_[points, np.ones(len(points))].T
            known = (depth[y, x] > 0) & (z > 0)
            ratios.append(depth[y, x][known] / THOUSAND / z[known])
            advance()
    ratio = np.concatenate(ratios)
    if len(ratio) < LEAST:
        raise InputError(f"--depths: only {len(ratio)} points of the model have a depth, which is too few to compare.")
    metres = float(np.median(ratio))
    spread = float(np.median(np.abs(ratio / metres - 1)))
    if spread > SPREAD:
        raise InputError(
            f"--depths contradict the model by {spread:.0%} at {len(ratio)} points: they are of other images, not "
            "registered to the colours, or no depths along the optical axis (disparities, say)."
        )
    return metres, f"depth images of {len(ratios) - 1} photos: they agree to {spread:.1%} at {len(ratio)} points"


def write_depths(
    files: Mapping[str, Path], photos: Sequence[Photo], units: float, scene: Path, factors: Sequence[int]
) -> dict[str, str]:
    """Writes depth images, and every n-th pixel of them beside downscaled images, to ``depths`` and ``depths_n``.

    ``units``, of the scene in a metre, of 1 keep millimetres, as whole numbers if they were; else files become .npy.
    Returns the path in the scene by name of the photo.
    """
    paths = {}
    with progress("Writing depths", len(photos)) as advance:
        for photo in photos:
            source, depth = files[photo.name], read_millimetres(files[photo.name]) * np.float32(units)
            is_whole = units == 1 and source.suffix.lower() == ".png" and not _is_tum(source)
            name = f"{Path(photo.name).stem}{'.png' if is_whole else '.npy'}"
            for factor in (1, *factors):
                rows, columns = (n // factor * factor for n in depth.shape)
                part = depth[factor // 2 : rows : factor, factor // 2 : columns : factor]
                target = scene / (f"depths_{factor}" if factor > 1 else "depths") / name
                with whole(target) as partial:
                    if is_whole and factor == 1:
                        shutil.copyfile(source, partial)
                    elif is_whole:
                        Image.fromarray(part.astype(np.uint16)).save(partial, format="PNG")
                    else:
                        with partial.open("wb") as file:
                            np.save(file, part)
            paths[photo.name] = f"depths/{name}"
            advance(1)
    return paths
