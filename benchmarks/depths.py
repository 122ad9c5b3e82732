"""Depths that are found in the images of procedural captures, whose true depths are known, and of others."""

from __future__ import annotations

import copy
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from report import Bench, Report, Row, page, table

from mmpi_ns.config import mmpi_small
from mmpi_ns.data.dataset import read_depth_image
from mmpi_ns.scripts.command import run
from mmpi_priors import cache
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset

CAPTURES = {
    "walk, 60 images": ("walk", 60, 480, 270),
    "walk, 20 images": ("walk", 20, 480, 270),
    "walk, 12 images": ("walk", 12, 480, 270),
    "street, 48 images": ("street", 48, 620, 188),
    "street, 16 images": ("street", 16, 620, 188),
    "street, a video: 120 images of 16 m": ("street", 120, 480, 270, 16.0),
}
"""Kind, number of images of the same way, their size, and its length where it is not the usual one."""
POINTS = 25
"""SfM points for each image."""


@dataclass(kw_only=True)
class DepthsBench(Bench):
    """Finds the depths of training images as ns-train does, and compares them with the true ones where they are known.

    Nothing is taken from ns-train's cache.
    """

    data: tuple[Path, ...] = ()
    """Captures (folders with transforms.json) beside the procedural ones, at half size if there are copies of it."""

    name = "depths"

    def run(self) -> None:
        report = Report(self, key=self.key("data"))
        for name, scene in CAPTURES.items():
            report.row(name, lambda scene=scene: self._row(self._scene(*scene), 1))
        for data in self.data:
            factor = 2 if (data / "images_2").is_dir() else 1
            report.row(data.resolve().name, lambda data=data, factor=factor: self._row(data, factor))
        report.finish({}, markdown(report.content))

    def _scene(self, kind: Any, count: int, width: int, height: int, length: float | None = None) -> Path:
        """A procedural capture, written unless it is there."""
        folder = self.folder / f"{kind}-{count}"
        if not (folder / "transforms.json").is_file():
            scene = make_scene(kind, 0, count, width, height, length)
            write_dataset(scene, folder, POINTS * count, processes=self.cores)
        return folder

    def _row(self, data: Path, downscale_factor: int) -> Row:
        with TemporaryDirectory() as empty, patch.object(cache, "cache_folder", lambda: Path(empty)):
            return depths_of(data, downscale_factor)


def depths_of(data: Path, downscale_factor: int) -> Row:
    """Share of the training pixels whose depth is known, and the errors where the true one is known, too."""
    config: Any = copy.deepcopy(mmpi_small.config.pipeline.datamanager)
    config.data, config.new_view_share, config.dataparser.downscale_factor = data, 0.0, downscale_factor
    config.priors.correct_exposure = config.priors.mask_moving = config.priors.depth_images = False
    start = time.process_time()
    manager = config.setup(device="cpu", test_mode="val")
    seconds, dataset, known = time.process_time() - start, manager.train_dataset, manager.priors.depths
    assert known is not None
    count = len(dataset)
    row: Row = {"images": count, "seconds_an_image": seconds / count, "share": known.share}
    outputs = manager.train_dataparser_outputs
    files = outputs.metadata.get("depth_filenames")
    if not files:
        return row
    unit = outputs.metadata["depth_unit_scale_factor"] * outputs.dataparser_scale
    errors = np.concatenate([errors_of(known.image(i), read_depth_image(Path(files[i]), unit), dataset, i)
                             for i in range(count)])  # fmt: skip
    row |= {"median_error": float(np.median(errors[:, 0])), "wrong": float((errors[:, 0] > 0.1).mean())}
    return row | {"beyond": float((errors[:, 1] > 3).mean())}


def errors_of(known: NDArray[Any], depth: NDArray[Any], dataset: Any, i: int) -> NDArray[np.float64]:
    """Of pixels where both are known: relative errors of inverse distances, and errors over expected ones. [P, 2]"""
    rays = dataset.cameras.generate_rays(i)
    ahead = (rays.directions @ -dataset.cameras.camera_to_worlds[i, :, 2])[..., None].numpy()[..., 0]
    true = np.where(depth > 0, ahead / np.maximum(depth, 1e-9), 0)
    both = (known[..., 0] > 0) & (depth > 0)
    apart = np.abs(known[..., 0] - true)[both]
    return np.stack([apart / true[both], apart / np.maximum(known[..., 1][both], 1e-12)], -1)


def markdown(content: Row) -> str:
    rows = [{"name": name, **row} for name, row in content["rows"].items()]

    def percent(name: str) -> Any:
        return lambda row: f"{100 * row[name]:.1f} %" if name in row else ""

    columns: dict[str, Any] = {
        "capture": "{name}",
        "training images": "{images}",
        "pixels with a depth": percent("share"),
        "error, median": percent("median_error"),
        "errors over a tenth": percent("wrong"),
        "over three expected errors": percent("beyond"),
        "processor s an image": "{seconds_an_image:.2f}",
    }
    intro = (
        "Procedural captures are of the same way, with fewer images farther apart, and have 25 SfM points an image. "
        "Depths are from points, matches, surfaces and what is extrapolated; errors are of inverse distances. Seconds "
        "include reading the images."
    )
    return page("Depths", content["made"], intro, table(columns, rows))


if __name__ == "__main__":
    sys.exit(run("depths", DepthsBench))
