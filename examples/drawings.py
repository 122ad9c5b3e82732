"""Drawings of the documentation: merging, reliability and expected errors, by the package's own functions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from mmpi_ns.blending import blend_shares, blended_optical_depth
from mmpi_ns.ops.composite import composite_weights
from mmpi_ns.placement.errors import mpi_errors
from mmpi_ns.placement.observations import Observations
from mmpi_ns.scene.geometry import Frames, inverse_distance, plane_hits, sample_disparity
from mmpi_ns.scene.plan import MPIPlan

COLORS = ("#2b66e8", "#dd8a00", "#2a9d3a")
AT_INFINITY = 120.0
"""Where the last plane is drawn on a scale of distances, m."""


def draw_merging(path: Path) -> None:
    """Three MPIs along a street, one ray, the planes that it crosses in each, and the samples in one order."""
    mpis = [_front("first", 0.0), _front("second", 14.0), _sideways("left", 26.0)]
    origin, direction = np.array([6.0, 0.0, 0.0]), np.array([1.0, 0.30, 0.0]) / np.hypot(1.0, 0.30)
    distances = _distances(mpis, origin, direction)
    figure = _figure(9.5, 6.2)
    axes = figure.add_subplot(3, 1, (1, 2), aspect="equal", xlabel="along the street, m", ylabel="to the left, m")
    axes.set_title("Each ray intersects the planes of every MPI that faces it ...", fontsize=11)
    axes.axhspan(-6, 6, color="0.93")
    axes.plot(np.arange(0, 41, 2.0), np.zeros(21), "k.", markersize=4, label="cameras")
    for mpi, t, color in zip(mpis, distances, COLORS, strict=True):
        _draw_frustum(axes, mpi, color)
        hits = origin[:2] + t[np.isfinite(t), None] * direction[:2]
        axes.plot(*hits.T, "o", color=color, markersize=6, markeredgecolor="white", markeredgewidth=0.6, zorder=5)
    start, end = ((float(x), float(y)) for x, y in (origin[:2], origin[:2] + 62 * direction[:2]))
    axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "lw": 1.4})
    axes.text(float(origin[0]) - 0.5, -2.6, "camera", ha="center")
    axes.set_xlim(-3, 66)
    axes.set_ylim(-13, 19)
    axes.legend(loc="lower right", fontsize=8)
    below = figure.add_subplot(3, 1, 3, xscale="log", xlabel="distance along the ray, m")
    below.set_title("... and the samples of all MPIs are merged by distance", fontsize=11)
    for k, (t, color) in enumerate(zip(distances, COLORS, strict=True)):
        shown = np.where(np.isfinite(t), t, AT_INFINITY)
        below.plot(shown, np.full(len(t), 3 - k), "o", color=color, markersize=6)
        below.vlines(shown, -0.35, 0.35, color=color, lw=3)
    below.axhline(0.6, color="0.7", lw=0.8)
    below.set_yticks([3, 2, 1, 0], [*(m.name for m in mpis), "merged"])
    ticks = [1, 2, 5, 10, 20, 50, AT_INFINITY]
    below.set_xticks(ticks, ["∞" if t == AT_INFINITY else f"{t:g}" for t in ticks])
    below.minorticks_off()
    below.set_ylim(-0.6, 3.6)
    figure.savefig(path, dpi=100)


def draw_reliability(path: Path) -> None:
    """Two MPIs with a wall, one of them also with a ghost in front of it: weights without and with reliability."""
    t = np.linspace(4, 13, 19)
    alpha = [0.8 * _bump(t, 10, 0.5), 0.7 * _bump(t, 10, 0.5) + 0.45 * _bump(t, 6.5, 0.6)]
    trust = [np.zeros_like(t), np.where(t < 8.3, -3.0, 0.0)]
    # Both MPIs have a sample at each distance; ties go to the first.
    tau = torch.from_numpy(-np.log1p(-np.stack(alpha, 1))).reshape(-1)
    reliability = torch.from_numpy(np.stack(trust, 1)).repeat_interleave(2, 0)
    own = torch.tensor([0, 1]).repeat(len(t))
    share, rest = blend_shares(reliability, torch.ones_like(reliability, dtype=torch.bool), own)
    weights = []
    for depth in (tau, blended_optical_depth(tau, share, rest)):
        starts, none = torch.tensor([0, len(depth)]), torch.zeros_like(depth)
        weights.append(composite_weights(depth, starts, none, none[:1, None]).weights.reshape(-1, 2).numpy())
    figure = _figure(9.5, 5.6)
    light = [100 * w[t < 8.3].sum() / w.sum() for w in weights]
    rows = [
        ("opacity α of the samples of two MPIs", np.stack(alpha, 1)),
        ("relative reliability P = softmax(R)", share.exp().reshape(-1, 2).numpy()),
        (f"weights without reliability: the ghost has {light[0]:.0f} % of the colour", weights[0]),
        (f"weights with α' = P α: the ghost has {light[1]:.0f} %", weights[1]),
    ]
    for k, (title, values) in enumerate(rows):
        axes = figure.add_subplot(2, 2, k + 1)
        axes.set_title(title, fontsize=10)
        for j, name in enumerate(("MPI 1: wall at 10 m", "MPI 2: wall, and ghost at 6.5 m")):
            axes.bar(t + 0.21 * (j - 0.5), values[:, j], 0.2, color=COLORS[j], label=name)
        axes.set_ylim(0, 1 if k < 2 else 0.5)
        axes.set_xlabel("distance along the ray, m")
    figure.axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=100)


def draw_errors(path: Path) -> None:
    """e_p and e_t of points so far ahead of a camera, against the camera's distance from the MPI's origin."""
    mpi = MPIPlan("front", (0.0, 0.0, 0.0), _axes((1.0, 0.0)), 3.0, (-1.0, 1.0, -0.4, 0.4), 64, 100, 250)
    figure = _figure(9.5, 3.6)
    steps = np.linspace(0, 15, 61)
    cameras = np.stack([steps, 0 * steps, 0 * steps], 1)
    panels = [
        figure.add_subplot(
            1, 2, k + 1, title=title, xlabel="camera's distance from the MPI's origin, m", ylabel="pixels"
        )
        for k, title in enumerate(("plane error $e_p$", "texel error $e_t$"))
    ]
    for depth, color in zip((5.0, 10.0, 30.0), COLORS, strict=True):
        points = cameras + np.array([depth, 0.5 * depth, 0.0])
        found = mpi_errors(mpi, _looking_ahead(cameras), np.arange(len(steps)), points)
        for axes, values in zip(panels, found, strict=True):
            axes.plot(steps, values, color=color, label=f"ahead of it; points {depth:g} m from the camera")
    aside = cameras[:, [1, 0, 2]]
    found = mpi_errors(mpi, _looking_ahead(aside), np.arange(len(steps)), aside + np.array([30.0, -15.0, 0.0]))
    for axes, values in zip(panels, found, strict=True):
        axes.plot(steps, values, color="black", ls=":", label="beside it")
        axes.set_ylim(0, 12)
        axes.grid(alpha=0.3)
    panels[1].legend(fontsize=8)
    figure.savefig(path, dpi=100)


def _distances(mpis: list[MPIPlan], origin: np.ndarray, direction: np.ndarray) -> list[np.ndarray]:
    """Distances at which a ray crosses the live planes of each MPI; inf for the plane at infinity."""
    frames = Frames.pack(mpis, dtype=torch.float64)
    origins, directions = torch.from_numpy(origin)[None], torch.from_numpy(direction)[None]
    near, far = torch.tensor([[0.5]], dtype=torch.float64), torch.tensor([[torch.inf]], dtype=torch.float64)
    hits = plane_hits(origins, directions, near, far, frames)
    found = []
    for k in range(len(mpis)):
        m = hits.m_first[0, k] - torch.arange(int(hits.count[0, k]))
        w = sample_disparity(m, frames.disparity_steps[k], frames.last_disparities[k])
        inverse = inverse_distance(w, hits.local_origins[0, k, 2], hits.local_directions[0, k, 2])
        found.append(np.array([1 / x if x > 0 else np.inf for x in inverse.tolist()]))
    return found


def _axes(facing: tuple[float, float]):
    x, y = facing
    return ((y, -x, 0.0), (0.0, 0.0, -1.0), (x, y, 0.0))


def _front(name: str, along: float) -> MPIPlan:
    return MPIPlan(name, (along, 0.0, 0.0), _axes((1.0, 0.0)), 5.0, (-0.75, 0.75, -0.4, 0.4), 10, 32, 64)


def _sideways(name: str, along: float) -> MPIPlan:
    return MPIPlan(name, (along, -10.0, 0.0), _axes((0.0, 1.0)), 14.0, (-1.0, 1.0, -0.4, 0.4), 7, 32, 64)


def _draw_frustum(axes: Axes, mpi: MPIPlan, color: str) -> None:
    origin, right, facing = np.asarray(mpi.origin)[:2], np.asarray(mpi.axes[0])[:2], np.asarray(mpi.axes[2])[:2]
    (u0, u1), far = mpi.extent[:2], 200.0

    def ends(depth: float) -> np.ndarray:
        return origin + depth * (facing + np.array([[u0], [u1]]) * right)

    axes.add_patch(Polygon([*ends(mpi.near), *ends(far)[::-1]], color=color, alpha=0.06, lw=0))
    for end in ends(far):
        axes.plot(*np.stack([origin, end]).T, color=color, lw=0.8)
    for share in np.linspace(0, 1, mpi.planes - 1, endpoint=False) * (mpi.planes - 2) / (mpi.planes - 1):
        axes.plot(*ends(mpi.near / (1 - share)).T, color=color, lw=1.0)
    axes.plot(*origin, "x", color=color, markersize=9, markeredgewidth=2.5, label=f"MPI '{mpi.name}'")


def _looking_ahead(places: np.ndarray, focal: float = 190.0) -> Observations:
    """Cameras at some places that look along x, with z up."""
    pose = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    poses = np.concatenate([np.tile(pose, (len(places), 1, 1)), places[:, :, None]], 2)
    pinholes, sizes = (np.tile(row, (len(places), 1)) for row in ([focal, focal, 160.0, 48.0], [320.0, 96.0]))
    return Observations(poses, pinholes, sizes)


def _bump(t: np.ndarray, middle: float, width: float) -> np.ndarray:
    return np.exp(-0.5 * ((t - middle) / width) ** 2)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
