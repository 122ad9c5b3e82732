"""What reliability is worth after joint training: it is learned on finished runs, all else frozen (paper sec. III-C).

A sample's optical depth is multiplied by its head's share P and by the number of heads that cover it. At R = 0 that is
1, so training starts at the run's own images. Written in plain torch, with the blending of the paper's methods.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from nerfstudio.cameras.rays import RayBundle
from report import Bench, Report, Row, page, table
from torch import Tensor, nn

from mmpi_ns.blending import blend_shares, find_votes
from mmpi_ns.data.rays import image_rays
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.composite import composite_weights
from mmpi_ns.ops.interpolate import Table, interpolate
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.rendering.metrics import psnr
from mmpi_ns.rendering.rendered import bounded
from mmpi_ns.sampler import march, rays_of
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.scripts.command import run
from mmpi_ns.training.losses import photometric
from mmpi_ns.training.touched_adam import TouchedAdam
from mmpi_show.bake import load_model

RATE, THRESHOLD, CHUNK = 0.02, 3e-3, 1 << 13
"""Learning rate at first, weight below which samples are dropped, and rays of an image that are rendered at once."""
KINDS = {"texels": (1, False), "bricks": (BRICK, False), "texels and distance": (1, True)}
"""Rows of the tables that have a reliability in common, and whether it falls with a camera's distance from the MPI."""


@dataclass
class ReliabilityOf(Bench):
    """Learns reliability on finished runs of mmpi and scores test images of the field, before and after."""

    load_configs: tuple[Path, ...]
    """config.yml of each run."""
    steps: int = 500
    """Steps of each kind, a fifth of a short run's."""
    images: int = 14
    """Test images that are scored, evenly spaced; 0 for all."""

    name = "reliability"

    def run(self) -> None:
        torch.set_num_threads(self.cores)
        report = Report(self, self.key("load_configs", "images"))
        for config in self.load_configs:
            pipeline = load_model(config)
            data, machine = pipeline.datamanager.config.dataparser, yaml.load(config.read_text(), yaml.Loader).machine
            name = f"{Path(data.data).name} /{data.downscale_factor}, seed {machine.seed}"
            print(name, report.row(name, partial(self._row, pipeline)), flush=True)
        report.finish({}, markdown(report.content, self.images))

    def _row(self, pipeline: Any) -> Row:
        scores = {"the run": score(pipeline, Reliability(pipeline.model.field, 1, False), self.images)}
        for kind, how in KINDS.items():
            torch.manual_seed(0)
            reliability = Reliability(pipeline.model.field, *how)
            learn(pipeline, reliability, self.steps)
            scores[kind] = score(pipeline, reliability, self.images)
        return {"scores": scores}


class Reliability:
    """R of the heads of a field.

    Args:
        field: of a run of mmpi.
        rows: that have a value in common.
        by_distance: R falls with a camera's distance from the MPI's origin, by a slope for each MPI.
    """

    def __init__(self, field: MMPIField, rows: int, by_distance: bool) -> None:
        self.field, self.rows = field, rows
        self.table = Table(torch.zeros(len(field.density) // rows, 1))
        self.slopes = nn.Parameter(torch.zeros(field.plan.num_heads))
        self.parameters = [self.table, self.slopes] if by_distance else [self.table]
        trained = torch.ones(len(field.density), dtype=torch.uint8)
        trained[:BRICK] = 0
        self.tables = field.tables._replace(touched=trained)

    def render(self, bundle: RayBundle) -> Tensor:
        """Colours of rays without a background, and transmittances. [R, 4]"""
        field, layout = self.field, self.field.layout
        samples = march(layout, field.tables, rays_of(bundle), MarchOptions(THRESHOLD, blends=False))
        numbers, shape = samples.rays, (len(samples.heads), layout.num_heads)
        places = bundle.origins[numbers], bundle.directions[numbers], samples.inverse_t, samples.heads
        votes = find_votes(layout, self.tables, *places)
        values = interpolate(self.table, votes.rows // self.rows, votes.weights)[:, 0]
        values = values.new_zeros(math.prod(shape)).index_copy(0, votes.places, values).view(shape)
        covers = torch.zeros(math.prod(shape), dtype=torch.bool).index_fill(0, votes.places, True).view(shape)
        away = (bundle.origins[:, None] - layout.frames.origins).norm(dim=-1) / field.plan.content_near
        log_share, _ = blend_shares(values - self.slopes * away[numbers], covers, samples.heads)
        tau = samples.tau * log_share.exp() * covers.sum(-1)
        composite = composite_weights(tau, samples.starts, samples.skipped_before, samples.skipped_total)
        rgb, _ = field.render_colors(bundle, samples, None, composite)
        return torch.cat([rgb, composite.transmittance], -1)


def learn(pipeline: Any, reliability: Reliability, steps: int) -> None:
    """Trains reliability alone on pixels of the training images."""
    model, manager = pipeline.model, pipeline.datamanager
    model.requires_grad_(False)
    optimizer = TouchedAdam(reliability.parameters, RATE)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1 / steps))
    for step in range(steps):
        bundle, batch = manager.next_train(step)
        rendered = reliability.render(bounded(bundle, model.field.plan))
        observed, exposure = batch["image"][:, :3], None
        if len(model.exposures.factors):
            exposure = model.exposures.factors[bundle.camera_indices[:, 0]]
            observed = observed / exposure
        loss = photometric(rendered[:, :3] + rendered[:, 3:] * observed, observed, exposure)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        decay.step()


@torch.no_grad()
def score(pipeline: Any, reliability: Reliability, count: int) -> float:
    """Mean PSNR of the field on test images."""
    model, images = pipeline.model, pipeline.datamanager.eval_dataset
    values, exposure = [], model.exposures.mean
    for i in np.linspace(0, len(images) - 1, min(count or len(images), len(images))).round().astype(int).tolist():
        camera, observed = images.cameras[i : i + 1], model.observed(images.get_data(i))
        bundle, image = bounded(image_rays(camera).flatten(), model.field.plan), model.get_outputs_for_camera(camera)
        rendered = torch.cat([reliability.render(bundle[j : j + CHUNK]) for j in range(0, len(bundle), CHUNK)])
        radiance = rendered[:, :3] + 0.5 * rendered[:, 3:] / (1.0 if exposure is None else exposure)
        image["rgb" if exposure is None else "radiance"] = radiance.clamp(min=0).view(observed.shape)
        values.append(psnr(pipeline.as_exposed(camera, image, observed)["rgb"].clamp(0, 1), observed))
    return float(np.mean(values))


def markdown(content: Row, images: int) -> str:
    """The page: a line for each capture, seeds as their mean."""
    scenes: dict[str, list[dict[str, float]]] = {}
    for name, row in content["rows"].items():
        scenes.setdefault(name.split(", ")[0], []).append(row["scores"])
    columns: dict[str, Any] = {"capture": "{scene}", "seeds": "{seeds}"}
    columns |= {name: f"{{{name}:.2f}}" for name in ("the run", *KINDS)}
    lines = [
        {"scene": scene, "seeds": len(scores)} | {name: np.mean([s[name] for s in scores]) for name in scores[0]}
        for scene, scores in scenes.items()
    ]
    chosen = f"at most {images} evenly spaced" if images else "all"
    intro = (
        f"PSNR of the field, dB, on {chosen} test images: of runs of `mmpi`, and after reliability alone was trained "
        "for a fifth as many steps, for each texel, for each brick, or for each texel with a slope over the camera's "
        "distance from each MPI."
    )
    return page("Reliability after joint training", content["made"], intro, table(columns, lines))


if __name__ == "__main__":
    sys.exit(run("reliability", ReliabilityOf))
