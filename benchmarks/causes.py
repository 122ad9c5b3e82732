"""Where the error of new views comes from: causes are taken away one by one, each by an oracle."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.model_components.lib_bilagrid import color_correct
from numpy.typing import NDArray
from plane_crossings import images_of
from refined import refined_camera
from report import Bench, Report, Row, page, table
from torch import Tensor

from mmpi_ns.data.posed_images import posed_images
from mmpi_ns.scripts.command import run
from mmpi_ns.utils.errors import InputError
from mmpi_priors.views import look_up, project
from mmpi_show.bake import load_model

Mask = NDArray[np.bool_]

SAME_DISTANCE = 0.05
"""A training image sees a point unless it shows something that is nearer by more than this share of its distance."""
LONG, THIN, CONTRAST = 0.2, 5, 40
"""Share of the width that counts as each border; side in pixels and levels of a thin structure (top hat)."""


@dataclass
class Causes(Bench):
    """Scores test images of finished runs, and again with a cause of error taken away.

    Colours: the affine map of colours that suits the test image best. Pose: where the frozen model shows the image
    best. Unseen: pixels are left out whose surface, by the model's own depth, too few training images see.
    """

    load_configs: tuple[Path, ...]
    """config.yml of each run."""
    images: int = 14
    """Test images, and training images, that are scored, evenly spaced; 0 for all."""

    name = "causes"

    def run(self) -> None:
        torch.set_num_threads(self.cores)
        report = Report(self, key=None)
        report.content["images"] = self.images
        for config in self.load_configs:
            pipeline = load_model(config)
            scene = Path(pipeline.datamanager.config.data).name
            report.row(scene, lambda p=pipeline: causes(p, self.images))
            print({scene: report.rows[scene]}, flush=True)
        report.finish({}, markdown(report.content))


@torch.no_grad()
def causes(pipeline: Any, count: int) -> Row:
    """PSNR of a run's images with causes of error taken away, and shares of the error by place."""
    model, manager = pipeline.model, pipeline.datamanager
    training = manager.train_dataset
    posed = posed_images(manager.observations, training)
    if posed is None:
        raise InputError("A camera of this capture is neither perspective nor fisheye: no pixel can be looked up.")
    renderings = [model.get_outputs_for_camera(training.cameras[i : i + 1]) for i in range(len(training))]
    distances = [outputs["depth"][..., 0].cpu().numpy() for outputs in renderings]
    scores: dict[str, list[float]] = {name: [] for name in CAUSES}
    for i in np.linspace(0, len(training) - 1, min(count or len(training), len(training))).round().astype(int):
        factor = model.exposures.factors[i] if len(model.exposures.factors) else 1.0
        rgb = (factor * renderings[i].get("radiance", renderings[i]["rgb"])).clamp(0, 1)
        scores["training images"].append(psnr_of(squared(rgb, model.observed(training.get_data(int(i))))))
    parts = []
    for i, (camera, image) in enumerate(images_of(pipeline, count)):
        outputs = pipeline.as_exposed(camera, model.get_outputs_for_camera(camera), image)
        with torch.enable_grad():
            moved = refined_camera(pipeline, camera, image, model.config.seed + i)[0]
        again = pipeline.as_exposed(moved, model.get_outputs_for_camera(moved), image)
        plain, fitted = squared(outputs["rgb"], image), squared(color_correct(again["rgb"], image), image)
        seen = times_seen(camera, outputs["depth"][..., 0].cpu().numpy(), posed, distances)
        for name, error in (
            ("test images", plain),
            ("... colours fitted", squared(color_correct(outputs["rgb"], image), image)),
            ("... poses refined", squared(again["rgb"], image)),
            ("... both", fitted),
        ):
            scores[name].append(psnr_of(error))
        for least in (1, 2, 3):
            scores[f"pixels that {least} or more training images see"].append(psnr_of(plain, seen >= least))
        scores["both, pixels that 2 or more see"].append(psnr_of(fitted, seen >= 2))
        parts.append((plain, np.stack([*(seen == n for n in (0, 1, 2)), seen > 2, borders(plain), thin(image)])))
    total = sum(error.sum() for error, _ in parts)
    pixels = [float(np.mean([masks[n].mean() for _, masks in parts])) for n in range(len(PARTS))]
    errors = [float(sum(error[masks[n]].sum() for error, masks in parts) / total) for n in range(len(PARTS))]
    psnr = {name: float(np.nanmean(values)) for name, values in scores.items()}
    return {
        "psnr": psnr,
        "pixels": dict(zip(PARTS, pixels, strict=True)),
        "error": dict(zip(PARTS, errors, strict=True)),
    }


CAUSES = (
    "training images",
    "test images",
    "... colours fitted",
    "... poses refined",
    "... both",
    *(f"pixels that {least} or more training images see" for least in (1, 2, 3)),
    "both, pixels that 2 or more see",
)
"""Rows of the first table."""
PARTS = ("seen by none", "seen by 1", "seen by 2", "seen by 3 or more", "left and right fifths", "thin structures")
"""Rows of the second."""


def squared(rendered: Tensor, image: Tensor) -> NDArray[np.float64]:
    """Squared error of each pixel, the mean over channels. [H, W]"""
    return ((rendered.cpu().double() - image.cpu().double()) ** 2).mean(-1).numpy()


def psnr_of(error: NDArray[np.float64], where: Mask | None = None) -> float:
    """PSNR of an image, or of some of its pixels; NaN where there are none."""
    chosen = error if where is None else error[where]
    return float(-10 * np.log10(max(chosen.mean(), 1e-12))) if chosen.size else float("nan")


def times_seen(camera: Any, distance: NDArray[np.float32], posed: Any, distances: list[NDArray]) -> NDArray[np.int64]:
    """How many training images see what a test image shows, by rendered distances. [H, W]"""
    rays = camera.to("cpu").generate_rays(0, keep_shape=True)
    points = (rays.origins + rays.directions * torch.from_numpy(distance)[..., None]).double().numpy()
    points, seen = points.reshape(-1, 3), np.zeros(distance.size, np.int64)
    for j, renderings in enumerate(distances):
        at = project(posed, j, points)
        own = np.linalg.norm(points - posed.camera_to_worlds[j, :, 3], axis=-1)
        there = look_up(renderings, *at.T, nearest=True)
        seen += (there > 0) & (there > (1 - SAME_DISTANCE) * own)
    return seen.reshape(distance.shape)


def borders(like: NDArray[Any]) -> Mask:
    """The left and right borders of an image."""
    across = (np.arange(like.shape[1]) + 0.5) / like.shape[1]
    return np.broadcast_to((across < LONG) | (across > 1 - LONG), like.shape)


def thin(image: Tensor) -> Mask:
    """Bright or dark structures that a square of THIN pixels does not fit into."""
    gray = cv2.cvtColor((image.cpu().numpy() * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
    square = np.ones((THIN, THIN), np.uint8)
    hats = (cv2.morphologyEx(gray, how, square) for how in (cv2.MORPH_TOPHAT, cv2.MORPH_BLACKHAT))
    return np.asarray(np.maximum(*hats) > CONTRAST)


def markdown(content: Row) -> str:
    """The page."""
    rows = content["rows"]

    def columns(show: Callable[[Row, str], str]) -> dict[str, Any]:
        return {scene: (lambda row, r=results: show(r, row["name"])) for scene, results in rows.items()}

    first = {"PSNR, dB": "{name}"} | columns(lambda r, name: f"{r['psnr'][name]:.2f}")
    second = {"share of the pixels, and of the squared error": "{name}"} | columns(
        lambda r, name: f"{r['pixels'][name]:.0%}, {r['error'][name]:.0%}"
    )
    intro = (
        f"Means over {f'at most {n} evenly spaced' if (n := content['images']) else 'all'} test images (and training "
        "images) of the field without details. Colours are fitted by an affine map, poses by "
        "the frozen model. A training image sees a point if its rendered depth there is not more than 5 % nearer."
    )
    tables = [table(first, ({"name": n} for n in CAUSES)), table(second, ({"name": n} for n in PARTS))]
    return page("Causes of error", content["made"], intro, *tables)


if __name__ == "__main__":
    sys.exit(run("causes", Causes))
