"""Captures whose poses are known, as bare images: real ones, and procedural ones with exact poses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mmpi_scene.catalogue import make_scene
from mmpi_scene.scene import render

Array = NDArray[np.float64]
Known = tuple[tuple[str, ...], Array, float, Callable[[int], Path | NDArray[np.uint8]]]
"""Names, camera to world, focal length at full size, and each image: its file, or its pixels."""
ROAD_PIECE = 64
"""Frames of each of the pieces that long-road is cut into."""


@dataclass(frozen=True)
class Truth:
    """What is known of a capture."""

    names: tuple[str, ...]
    """Of the N images."""
    centers: Array
    """Camera centres. [N, 3]"""
    rotations: Array
    """Camera to world, OpenCV axes. [N, 3, 3]"""
    focal: float
    """Pixels."""


@dataclass(frozen=True)
class Capture:
    """One row of the table."""

    name: str
    source: str
    """Of ``--data``, or of the catalogue of procedural scenes."""
    is_real: bool
    start: int = 0
    stop: int | None = None
    step: int = 1
    half: bool = False
    """Images at half size."""
    count: int | None = None
    """Images of a procedural scene."""
    length: float | None = None

    def write(self, data: Path, folder: Path) -> Truth:
        """Writes the bare images, but for those that are there, and returns what is known of them.

        Raises:
            ValueError: the scene is not there.
        """
        folder.mkdir(parents=True, exist_ok=True)
        names, poses, focal, picture = self._real(data / self.source) if self.is_real else self._made()
        for i, name in enumerate(names):
            if not (folder / name).exists():
                self._save(picture(i), folder / name)
        focal /= 2 if self.half else 1
        return Truth(names, poses[:, :3, 3], poses[:, :3, :3] * [1, -1, -1], focal)

    def _real(self, scene: Path) -> Known:
        path = scene / "transforms.json"
        if not path.is_file():
            raise ValueError(f"{path} is not there")
        meta = json.loads(path.read_text(encoding="utf-8"))
        frames = sorted(meta["frames"], key=lambda f: f["file_path"])[self.start : self.stop : self.step]
        names = tuple(Path(f["file_path"]).name for f in frames)
        poses = np.array([f["transform_matrix"] for f in frames], dtype=np.float64)
        return names, poses, meta["fl_x"], lambda i: scene / frames[i]["file_path"]

    def _made(self) -> Known:
        scene = make_scene(self.source, 0, self.count, 640, 360 if self.length is None else 192, self.length)
        chosen = range(len(scene.cameras))[self.start : self.stop : self.step]
        names = tuple(f"frame_{i + 1:05d}.png" for i in chosen)
        poses = np.asarray(scene.cameras.camera_to_worlds)[list(chosen)]
        return names, poses, scene.cameras.focal, lambda i: (render(scene, chosen[i])[0] * 255).round().astype(np.uint8)

    def _save(self, picture: Path | NDArray[np.uint8], path: Path) -> None:
        """A file as it is; or an even cut of the image at half size, box-filtered."""
        if isinstance(picture, Path) and not self.half:
            shutil.copyfile(picture, path)
            return
        image = (Image.open(picture) if isinstance(picture, Path) else Image.fromarray(picture)).convert("RGB")
        if self.half:
            width, height = image.width // 2, image.height // 2
            image = image.crop((0, 0, 2 * width, 2 * height)).resize((width, height), Image.Resampling.BOX)
        image.save(path, quality=95)


def catalogue() -> dict[str, Capture]:
    """All captures by name: each as it is, at half size, and every second frame."""
    base = [Capture("kitti-street", "kitti-street", True)]
    for piece in range(5):
        first = ROAD_PIECE * piece
        base.append(Capture(f"long-road-{piece + 1}", "long-road", True, first, first + ROAD_PIECE))
    base += [Capture(name, name, True) for name in ("fern", "fox", "room-walk")]
    base += [
        Capture("street", "street", False, count=48, length=40.0),
        Capture("bends", "long-road", False, count=64, length=64.0),
        Capture("loop", "room", False, count=64),
        Capture("orbit", "object", False, count=48),
    ]
    results: dict[str, Capture] = {}
    for capture in base:
        results[capture.name] = capture
        results[f"{capture.name}-half"] = replace(capture, name=f"{capture.name}-half", half=True)
        results[f"{capture.name}-second"] = replace(capture, name=f"{capture.name}-second", step=2)
    return results
