"""PSNR against seconds, from the log of the trainer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

TEST, TRAIN = "Eval Images Metrics Dict (all images)/psnr", "Train Loss Dict/rgb_loss"
"""nerfstudio's names of the quantities drawn."""


def read_curve(run: Path, tag: str) -> NDArray[np.float64]:
    """A logged quantity: rows of (wall time, step, value), in order of time.

    Args:
        run: folder of the event files; a run that was resumed has several.
        tag: its name.
    """
    rows = []
    for file in sorted(run.glob("events.out.tfevents.*")):
        events = EventAccumulator(str(file), size_guidance={SCALARS: 0})
        events.Reload()
        if tag in events.Tags()["scalars"]:
            rows += [(e.wall_time, e.step, e.value) for e in events.Scalars(tag)]
    return np.array(sorted(rows), dtype=np.float64).reshape(-1, 3)


def psnr_of_squared_error(error: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-10 * np.log10(np.maximum(error, 1e-12)), np.float64)


def draw_curve(run: Path, target: Path, started: float, title: str) -> float:
    """Draws PSNR against seconds since the start; returns the last PSNR over the test images.

    Args:
        run: folder of the event files.
        target: png to write.
        started: wall time at which training was started, placement and loading included.
        title: of the picture.

    Raises:
        ValueError: the run logged no evaluation.
    """
    test, train = read_curve(run, TEST), read_curve(run, TRAIN)
    if not len(test):
        raise ValueError(f"{run} holds no scores: train with --vis tensorboard and --steps-per-eval-all-images.")
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xlabel="seconds since ns-train was started", ylabel="PSNR, dB", title=title)
    if len(train):
        axes.plot(
            train[:, 0] - started, psnr_of_squared_error(train[:, 2]), ".", color="0.75", label="training batches"
        )
    axes.plot(test[:, 0] - started, test[:, 2], "o-", color="#d62728", label="test images")
    last = (test[-1, 0] - started, test[-1, 2])
    axes.annotate(f"{last[1]:.1f} dB", last, xytext=(0, -18), textcoords="offset points", ha="right")
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(target, dpi=110)
    return float(test[-1, 2])
