"""``mmpi-bench regions``: does the error that placement expects show up in the pictures, region by region?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mmpi_ns.bench.rendering import images_of
from mmpi_ns.bench.report import Bench, Report, page
from mmpi_ns.export.bake import load_model
from mmpi_ns.placement.errors import WORST, pixel_errors
from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.scene.plan import ScenePlan

MIN_POINTS = 5
"""SfM points that a region must hold for its expected error to count."""


@dataclass
class Regions(Bench):
    """Expected pixel error against measured colour error over regions of the test images of a trained run."""

    load_config: Path
    """The run's config.yml."""
    rows: int = 3
    """Regions down an image."""
    columns: int = 8
    """Regions across an image."""

    name = "regions"

    def run(self) -> None:
        pipeline = load_model(self.load_config)
        manager, model = pipeline.datamanager, pipeline.model
        points = manager.observations.points
        if not len(points):
            raise ValueError("The scene has no SfM points in colmap/sparse/0: nothing to expect errors of.")
        found: list[tuple[float, ...]] = []
        for camera, truth in images_of(pipeline):
            with torch.no_grad():
                rgb = model.get_outputs_for_camera(camera)["rgb"].cpu()
            squared = ((rgb - truth) ** 2).mean(-1).numpy(), squared_slope(truth.numpy())
            found += self._regions(_as_observations(camera), points, model.field.plan, *squared)
        expected, errors, slopes = np.array(found).T
        # A pixel of displacement costs what the image changes over a pixel: nothing on a plain wall.
        head = {"regions": len(found), "rank_correlation": spearman(expected, errors)}
        head["rank_correlation_in_pixels"] = spearman(expected, errors / np.maximum(slopes, 1e-6))
        report = Report(self, key=None)
        said = "Rank correlation of the expected error with the error of colours in {regions} regions of test images:"
        said += " {rank_correlation:.2f}; with that error in pixels {rank_correlation_in_pixels:.2f}."
        report.finish(head, page("Expected and measured errors", report.content["made"], said.format(**head)))
        print(head)

    def _regions(
        self, camera: Observations, points: Array, plan: ScenePlan, *squared: Array
    ) -> list[tuple[float, ...]]:
        """Median expected error, then the root means of maps of squares [H, W], of every region with enough points."""
        only, found = np.zeros(len(points), np.int64), []
        pixels, ahead = camera.project(only, points)
        height, width = squared[0].shape
        row = np.floor(pixels[:, 1] / height * self.rows)
        column = np.floor(pixels[:, 0] / width * self.columns)
        errors = pixel_errors(plan, camera, only, points).combined.min(-1)
        for r, c in np.ndindex(self.rows, self.columns):
            inside = ahead & (row == r) & (column == c)
            if inside.sum() < MIN_POINTS:
                continue
            rows = slice(r * height // self.rows, (r + 1) * height // self.rows)
            columns = slice(c * width // self.columns, (c + 1) * width // self.columns)
            areas = (float(np.sqrt(area[rows, columns].mean())) for area in squared)
            found.append((float(np.median(np.minimum(errors[inside], WORST))), *areas))
        return found


def squared_slope(image: Array) -> Array:
    """[H, W] what an image [H, W, 3] changes over a pixel, squared: mean over colours, sum over both directions."""
    down, right = np.gradient(image, axis=(0, 1))
    return (down**2 + right**2).mean(-1)


def spearman(a: Array, b: Array) -> float:
    """Rank correlation; ties get their mean rank."""
    return float(np.corrcoef(_ranks(a), _ranks(b))[0, 1])


def _ranks(values: Array) -> Array:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2)[inverse]


def _as_observations(camera) -> Observations:
    """One nerfstudio camera, without points."""
    flat = [float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy)]
    size = [float(camera.width), float(camera.height)]
    return Observations.of_cameras(camera.camera_to_worlds.double().cpu().numpy(), [flat], [size])
