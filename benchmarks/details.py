"""What the details of training images are worth, and what they cost: without, with several numbers of images and shares
of their differences."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from report import Bench, Report, Row, page, table
from trainers import clock

from mmpi_ns.data.dataset import image_and_mask
from mmpi_ns.data.rays import image_rays
from mmpi_ns.rendering import details
from mmpi_ns.rendering.metrics import psnr, ssim
from mmpi_ns.scripts.command import run
from mmpi_ns.training.checkpoints import checkpoints_in
from mmpi_show.bake import load_model

NEAREST = (2, 4, 6, 8)
STRENGTHS = (0.5, 1.0)


@dataclass
class DetailsOf(Bench):
    """Scores test images of finished runs without details and with them; makes them where a run has none.

    Made here, they lack the masks of what moves, which only a training looks for.
    """

    load_configs: tuple[Path, ...]
    """config.yml of each run."""
    images: int = 14
    """Test images that are scored, evenly spaced; 0 for all."""

    name = "details"

    def run(self) -> None:
        torch.set_num_threads(self.cores)
        report = Report(self, key=None)
        for config in self.load_configs:
            pipeline = load_model(config)
            row = report.row(
                Path(pipeline.datamanager.config.data).name, partial(scores, pipeline, config, self.images)
            )
            print(row, flush=True)
        report.finish({}, markdown(report.content))


def settings(usual: int) -> dict[str, tuple[int, float]]:
    """Numbers of images and shares of differences by their names."""
    images = {f"{n} images": (n, details.STRENGTH) for n in sorted({*NEAREST, usual})}
    return images | {f"{usual} images, {share:.0%} of a difference": (usual, share) for share in STRENGTHS}


@torch.no_grad()
def scores(pipeline: Any, config: Path, count: int) -> Row:
    """PSNR and SSIM of a run's test images, and seconds for their details, for every setting."""
    model, images, usual = pipeline.model, pipeline.datamanager.eval_dataset, pipeline.model.config.rendering
    kept, making = details_of_run(pipeline, config)
    values: dict[str, list[tuple[float, float, float]]] = {}
    for i in np.linspace(0, len(images) - 1, min(count or len(images), len(images))).round().astype(int).tolist():
        observed = model.observed(images.get_data(i))
        camera = images.cameras[i : i + 1].to(model.device)
        bundle, field = image_rays(camera), model.get_outputs_for_camera(camera)
        exposure = model.exposures.mean
        for name, (nearest, share) in {"none": (0, 0.0), **settings(usual.nearest_images)}.items():
            start = clock()
            with mock.patch.object(details, "STRENGTH", share):
                rendered = kept.added(field, bundle, nearest, exposure) if nearest else field
            seconds = clock() - start
            rgb = pipeline.as_exposed(camera, rendered, observed)["rgb"]
            values.setdefault(name, []).append((psnr(rgb, observed), ssim(rgb, observed), seconds))
    means = {name: np.mean(numbers, 0).tolist() for name, numbers in values.items()}
    height, width = (int(n[0]) for n in (images.cameras.height, images.cameras.width))
    return {
        "scores": means,
        "making": making,
        "size": [width, height],
        "images": len(pipeline.datamanager.train_dataset),
    }


def details_of_run(pipeline: Any, config: Path) -> tuple[details.Details, float]:
    """The details of a run, made if it has none, and seconds of making them for all training images."""
    model, training, folder = pipeline.model, pipeline.datamanager.train_dataset, config.parent / details.DETAILS_FOLDER
    step, start = max(checkpoints_in(config.parent / "nerfstudio_models")), clock()
    kept = details.details_of(folder, step)
    if kept is None:
        cameras = details.moved_cameras(training.cameras.to(model.device), model.camera_optimizer)
        image_of, render = partial(image_and_mask, training), model.get_outputs_for_camera_ray_bundle
        print(details.write_details(folder, step, cameras, model.exposures.factors, image_of, render))
        kept = details.details_of(folder, step)
    assert kept is not None
    return kept, clock() - start


def markdown(content: Row) -> str:
    """The page."""
    rows = content["rows"]
    names = list(dict.fromkeys(name for row in rows.values() for name in row["scores"]))
    columns: dict[str, Any] = {"details of": "{name}"}
    for scene, row in rows.items():
        heading = f"{scene}, {row['images']} training images, {row['size'][0]} x {row['size'][1]}"
        columns[heading] = lambda line, r=row: "{:.2f} / {:.3f}, {:.3f} s".format(*r["scores"][line["name"]])
    intro = (
        "PSNR, dB, and SSIM of test images, and seconds that their details take; none: the field alone. "
        f"Of a difference {details.STRENGTH:.0%} is shown unless a row says otherwise."
    )
    return page("Details of training images", content["made"], intro, table(columns, ({"name": n} for n in names)))


if __name__ == "__main__":
    sys.exit(run("details", DetailsOf))
