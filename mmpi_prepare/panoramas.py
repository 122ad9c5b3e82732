"""Recognition of panoramas of 360-degree cameras, and their perspective faces, which form a rig for COLMAP.

The faces are those of a cube without the one that faces down, which shows the tripod or the photographer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from mmpi_ns.data.exif import kept_tags
from mmpi_ns.utils.errors import InputError, log, progress
from mmpi_ns.utils.files import opened, whole
from mmpi_prepare.export import Split, split_images
from mmpi_prepare.images import QUALITY, Photo, in_short
from mmpi_prepare.settings import Settings

FACES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
"""Axes of the faces (right, down, ahead) in those of the front face: the rotation from it to each."""
SAMPLE = 16
"""Images checked for whether those that are twice as wide as high are panoramas."""
APART = 8
"""Columns of an image that are compared with each other."""
OTHERS = ("poses", "depths", "focal", "camera", "lens", "intrinsics", "refine_intrinsics")
"""Options for cameras that are not panoramic."""


def wraps(pixels: NDArray[np.uint8]) -> bool:
    """Whether the first and the last column of an image [h, w, ...] continue each other: their difference is nearer, as
    a ratio, to that of neighbouring columns than to that of columns far apart, and clearly below the latter."""
    columns = np.moveaxis(pixels, 1, 0).astype(np.float32)
    seam, *near = (np.abs(columns[a] - columns[b]).mean() for a, b in ((0, -1), (0, 1), (-2, -1)))
    some = columns[np.linspace(0, len(columns), APART, endpoint=False).astype(int)]
    far = np.median([np.abs(some[i] - some[j]).mean() for i in range(APART) for j in range(i)])
    return bool(seam**2 < np.mean(near) * far and seam < far / 2)


def are_panoramas(folder: Path, photos: Sequence[Photo]) -> bool:
    """Whether images are panoramas: the edges of most images twice as wide as high, to a pixel, match. Raises
    InputError where others are among them, or they are of several sizes."""
    fitting = [p for p in photos if abs(p.width - 2 * p.height) <= 1]
    going_round = []
    for photo in fitting[:: max(1, len(fitting) // SAMPLE)]:
        with opened(folder / photo.name) as image:
            going_round.append(wraps(np.asarray(image)))
    if not fitting or np.mean(going_round) <= 0.5:
        return False
    usual = (fitting[0].width, fitting[0].height)
    others = [p.name for p in photos if (p.width, p.height) != usual]
    if others:
        raise InputError(
            f"{len(photos) - len(others)} of {len(photos)} images are 360-degree panoramas of {usual[0]}x{usual[1]} "
            f"({fitting[0].name}), the others are not ({in_short(others)}): prepare them apart."
        )
    return True


def cut(images: Path, photos: Sequence[Photo], masks: Path | None, target: Path) -> list[Photo]:
    """The faces of panoramas, all of a direction before the next one, written to ``target/images``, and those of masks
    (``NAME.png``) to ``target/masks``; nothing of other images."""
    if not are_panoramas(images, photos):
        return []
    log(f"{len(photos)} panoramas, each cut into {len(FACES)} faces ({', '.join(FACES)}); what is below is left out.")
    side = photos[0].width // 8 * 2  # as many pixels as what the faces show has in the panorama
    places = _places(photos[0].width, photos[0].height, side)
    with progress("Cutting panoramas", len(photos)) as advance:
        for photo in photos:
            files = [(images / photo.name, "images", "", cv2.INTER_LINEAR)]
            files += [(masks / f"{photo.name}.png", "masks", ".png", cv2.INTER_NEAREST)] if masks else []
            for source, folder, suffix, how in files:
                with opened(source) as image:
                    pixels, tags = np.asarray(image), kept_tags(image)
                pixels = cv2.copyMakeBorder(pixels, 0, 0, 1, 1, cv2.BORDER_WRAP)
                for face, (x, y) in places.items():
                    file = target / folder / f"{face}-{photo.name}{suffix}"
                    if not file.exists():
                        part = Image.fromarray(cv2.remap(pixels, x, y, how, borderMode=cv2.BORDER_REPLICATE))
                        with whole(file) as partial:
                            form = "PNG" if file.suffix.lower() == ".png" else "JPEG"
                            part.save(partial, format=form, quality=QUALITY, subsampling=0, exif=tags)
            advance(1)
    return [replace(p, name=f"{f}-{p.name}", width=side, height=side, lens=f) for f in FACES for p in photos]


def _places(width: int, height: int, side: int) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Of each face, column and row in a panorama, with a column more on either side, of its pixels. [side, side]"""
    x = (np.arange(side) + 0.5) * 2 / side - 1
    rays = np.stack([*np.meshgrid(x, x), np.ones((side, side))], -1)
    places = {}
    for face, turn in FACES.items():
        right, down, ahead = np.moveaxis(rays @ np.array(turn, np.float64), -1, 0)
        column = (np.arctan2(right, ahead) / (2 * np.pi) + 0.5) * width + 0.5
        row = (np.arctan2(down, np.hypot(right, ahead)) / np.pi + 0.5) * height - 0.5
        places[face] = column.astype(np.float32), row.astype(np.float32)
    return places


def check(settings: Settings) -> None:
    """Raises InputError if an option is not for panoramas."""
    given = [f"--{n.replace('_', '-')}" for n in OTHERS if getattr(settings, n) != getattr(Settings, n)]
    if given:
        raise InputError(f"Panoramas of a 360-degree camera take no {' and no '.join(given)}: leave it out.")


def join(database: Path) -> None:
    """Groups the faces of each panorama in a database into a frame of a rig, which has one pose."""
    cameras = []
    for face, turn in FACES.items():
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(turn, np.float64)), np.zeros(3)) if cameras else None
        cameras.append(pycolmap.RigConfigCamera(ref_sensor=not cameras, image_prefix=f"{face}-", cam_from_rig=pose))
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=cameras)], opened)


def split_panoramas(names: Sequence[str], test_every: int | None) -> Split:
    """As ``split_images``, with all faces of a panorama on one side."""
    fronts = split_images([n for n in names if n.startswith("front-")], test_every)
    train, test = (
        tuple(n for n in names if f"front-{n.partition('-')[2]}" in side) for side in (fronts.train, fronts.test)
    )
    return Split(train, test, f"of the panoramas, {fronts.summary}")
