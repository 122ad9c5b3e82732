"""Console output of a training run: progress lines, and at the end its quality and the next commands."""

from __future__ import annotations

import math
from pathlib import Path
from time import monotonic

import numpy as np
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from mmpi_ns.rendering.metrics import psnr_and_ssim
from mmpi_ns.rendering.pipeline import MMPIPipeline
from mmpi_ns.training.phases import Schedule
from mmpi_ns.utils.errors import duration, log, quoted

FIRST_LINE, SHARE, LEAST_SECONDS, MOST_SECONDS = 10, 0.025, 2.0, 30.0
"""The first progress line comes after so many steps; others after a fraction of all steps and at least so many seconds,
or after at most so many."""
VIEWS, LOOK_SECONDS = 4, 20.0
"""Quick test: maximum number of test images, and seconds after which no further one is started."""
EARLY_COST = 2.0
"""Time of a step before surfaces have formed, relative to a later one: rays have more samples then. 1.5 to 3 on
kitti-street and fox. The predictions stay within a third of what was left."""


class TrainingLog:
    """Prints the progress of a run from its ``first`` step, with ``rays`` a step after the texels have grown."""

    def __init__(self, schedule: Schedule, rays: int, first: int) -> None:
        self.schedule, self.rays, self.first = schedule, rays, first
        self._logged = 0
        """Steps at the time of the last line,"""
        self._logged_at = 0.0
        """and that time."""

    def note(self, step: int, rgb_loss: Tensor) -> None:
        """Called after each step with its squared colour error; prints if a line is due."""
        done, now, schedule = step + 1, monotonic(), self.schedule
        if step == self.first:  # includes compilation
            self._logged, self._logged_at = done, now
        since, seconds, end = done - self._logged, now - self._logged_at, schedule.total_steps
        due = (since >= SHARE * (end - self.first) and seconds >= LEAST_SECONDS) or seconds > MOST_SECONDS
        if since == 0 or not (due or done == end or done - self.first == FIRST_LINE):
            return
        window, phase = schedule.window_at(step), schedule.phase_at(step).name
        where = phase if schedule.windows == 1 else f"window {window + 1} of {schedule.windows}, {phase}"
        psnr = -10 * math.log10(max(float(rgb_loss.detach()), 1e-12))
        log(
            f"step {done:,} of {end:,} | {where} | {self.rays * since / max(seconds, 1e-9):,.0f} rays/s | "
            f"batch PSNR {psnr:.1f} dB | {duration(seconds / since * self.remaining(self._logged, step))} left"
        )
        self._logged, self._logged_at = done, now

    def remaining(self, first: int, last: int) -> float:
        """Steps after ``last``, each counted by its time relative to the mean of those from ``first`` to ``last``."""
        steps = range(first, self.schedule.total_steps)
        costs = [1.0 if self.schedule.sharpened(s) else EARLY_COST for s in steps]
        count = last + 1 - first
        return sum(costs[count:]) * count / sum(costs[:count])


@torch.no_grad()
def quick_test(pipeline: MMPIPipeline, images: InputDataset) -> str:
    """PSNR and SSIM of a few test images, as ``ns-eval`` scores them, as a sentence. The pipeline is in training mode
    afterwards."""
    pipeline.eval()
    scores, began, count = [], monotonic(), min(VIEWS, len(images))
    for i in np.linspace(0, len(images) - 1, count).round().astype(int).tolist():
        outputs, observed = pipeline.outputs_of(images.cameras[i : i + 1], images.get_data(i, image_type="float32"))
        scores.append(psnr_and_ssim(outputs["rgb"], observed))
        if monotonic() - began > LOOK_SECONDS:
            break
    pipeline.train()
    psnr, ssim = ([values[name] for values in scores if name in values] for name in ("psnr", "ssim"))
    text = f"PSNR {np.mean(psnr):.2f} dB ({min(psnr):.1f} to {max(psnr):.1f})"
    text += f", SSIM {np.mean(ssim):.3f}" if ssim else ""
    return f"Quick test on {len(scores)} of {len(images)} test images: {text}."


def next_commands(folder: Path) -> str:
    """The folder of a run, and the next commands."""
    config, scores, film = (quoted(folder / name) for name in ("config.yml", "eval.json", "fly.mp4"))
    return (
        f"The run is in {folder}. Next:\n  ns-eval --load-config {config} --output-path {scores}\n"
        f"  ns-render interpolate --load-config {config} --pose-source train --output-path {film}\n"
        f"  ns-viewer --load-config {config}"
    )
