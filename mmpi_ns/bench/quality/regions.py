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
        expected, errors, slopes = [], [], []
        for camera, truth in images_of(pipeline):
            with torch.no_grad():
                rgb = model.get_outputs_for_camera(camera)["rgb"].cpu()
            squared = ((rgb - truth) ** 2).mean(-1).numpy()
            found = self._regions(
                _as_observations(camera), points, model.field.plan, squared, squared_slope(truth.numpy())
            )
            for values, more in zip((expected, errors, slopes), found, strict=True):
                values += more
        # A pixel of displacement costs what the image changes over a pixel: nothing on a plain wall.
        pixels = np.array(errors) / np.maximum(slopes, 1e-6)
        found = {"regions": len(expected), "rank_correlation": spearman(np.array(expected), np.array(errors))}
        found["rank_correlation_in_pixels"] = spearman(np.array(expected), pixels)
        report = Report(self, key=None)
        said = "Rank correlation of the expected error with the error of colours in {regions} regions of test images:"
        said += " {rank_correlation:.2f}; with that error in pixels {rank_correlation_in_pixels:.2f}."
        report.finish(found, page("Expected and measured errors", report.content["made"], said.format(**found)))
        print(found)

    def _regions(self, camera: Observations, points: Array, plan: ScenePlan, *squared: Array) -> list[list[float]]:
        """Median expected error, then the root means of maps of squares [H, W], of every region with enough points."""
        only = np.zeros(len(points), np.int64)
        pixels, ahead = camera.project(only, points)
        height, width = squared[0].shape
        row = np.floor(pixels[:, 1] / height * self.rows).astype(int)
        column = np.floor(pixels[:, 0] / width * self.columns).astype(int)
        errors = pixel_errors(plan, camera, only, points).combined.min(-1)
        found: list[list[float]] = [[] for _ in range(1 + len(squared))]
        for r in range(self.rows):
            for c in range(self.columns):
                inside = ahead & (row == r) & (column == c)
                if inside.sum() < MIN_POINTS:
                    continue
                rows = slice(r * height // self.rows, (r + 1) * height // self.rows)
                columns = slice(c * width // self.columns, (c + 1) * width // self.columns)
                found[0].append(float(np.median(np.minimum(errors[inside], WORST))))
                for values, area in zip(found[1:], squared, strict=True):
                    values.append(float(np.sqrt(area[rows, columns].mean())))
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
    empty = np.zeros(0, np.int64)
    return Observations(
        camera_to_worlds=camera.camera_to_worlds.double().cpu().numpy(),
        intrinsics=np.array([flat]),
        sizes=np.array([[float(camera.width), float(camera.height)]]),
        points=np.zeros((0, 3)),
        seen_by=empty,
        seen_point=empty,
        seen_at=np.zeros((0, 2)),
    )
