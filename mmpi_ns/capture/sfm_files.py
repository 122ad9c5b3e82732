"""Checks that the files of a binary COLMAP model are complete and consistent, before pycolmap reads them.

pycolmap trusts the counts in the files: a truncated file makes it allocate gigabytes or end the process.
The format: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 16)
"""Of COLMAP's camera models, by their numbers; a higher number is of a newer COLMAP and not checked."""
KEYPOINT = np.dtype([("place", "<f8", 2), ("point", "<u8")])
NO_POINT = np.uint64(2**64 - 1)


class Damaged(ValueError):
    """What is wrong with a model's files, as part of a sentence."""


class _Reader:
    """Reads a file from its beginning, and never past its end."""

    def __init__(self, path: Path) -> None:
        self.name, self.data, self.at = path.name, path.read_bytes(), 0

    def take(self, form: str) -> tuple:
        size = struct.calcsize(form)
        self.skip(size)
        return struct.unpack_from(form, self.data, self.at - size)

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise Damaged(f"{self.name} ends too early, after {len(self.data)} bytes")

    def count(self, least: int) -> int:
        """A number of records of at least this many bytes each, which must fit into the rest of the file."""
        (number,) = self.take("<Q")
        if number * least > len(self.data) - self.at:
            raise Damaged(f"{self.name} says it has {number} records and has room for fewer")
        return number

    def end(self) -> None:
        if self.at != len(self.data):
            raise Damaged(f"{self.name} has {len(self.data) - self.at} bytes too many")


def check_model_files(folder: Path) -> None:
    """Raises Damaged if the binary files of a model are truncated or refer to missing records."""
    if not all((folder / f"{name}.bin").is_file() for name in ("cameras", "images", "points3D")):
        return
    cameras = _cameras(_Reader(folder / "cameras.bin"))
    images, seen = _images(_Reader(folder / "images.bin"), cameras)
    points = _points(_Reader(folder / "points3D.bin"), images)
    lost = seen - points
    if lost:
        raise Damaged(f"images.bin names point {min(lost)}, which points3D.bin has not")


def _cameras(file: _Reader) -> set[int]:
    cameras = set()
    for _ in range(file.count(24)):
        number, model, _, _ = file.take("<IiQQ")
        if not 0 <= model < len(PARAMETERS):
            raise Damaged(f"cameras.bin has a camera of model {model}, which is not known")
        file.skip(8 * PARAMETERS[model])
        cameras.add(number)
    file.end()
    return cameras


def _images(file: _Reader, cameras: set[int]) -> tuple[dict[int, int], set[int]]:
    """Keypoints of each image, and the points that any of them belongs to."""
    images, seen = {}, []
    for _ in range(file.count(73)):
        number, *_, camera = file.take("<I7dI")
        if camera not in cameras:
            raise Damaged(f"images.bin names camera {camera}, which cameras.bin has not")
        end = file.data.find(b"\0", file.at)
        if end < 0:
            raise Damaged("images.bin ends within a name")
        file.at = end + 1
        images[number] = file.count(24)
        begin = file.at
        file.skip(24 * images[number])
        seen.append(np.frombuffer(file.data, KEYPOINT, images[number], begin)["point"])
    file.end()
    return images, set(np.unique(np.concatenate([*seen, [NO_POINT]])).tolist()) - {int(NO_POINT)}


def _points(file: _Reader, images: dict[int, int]) -> set[int]:
    points = set()
    for _ in range(file.count(51)):
        number, *_ = file.take("<Q3d3Bd")
        length = file.count(8)
        begin = file.at
        file.skip(8 * length)
        for image, keypoint in struct.iter_unpack("<II", file.data[begin : file.at]):
            if keypoint >= images.get(image, 0):
                raise Damaged(f"points3D.bin names keypoint {keypoint} of image {image}, which images.bin has not")
        points.add(number)
    file.end()
    return points
