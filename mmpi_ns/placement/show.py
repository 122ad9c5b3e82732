"""Report of a plan: the table that ``mmpi-plan`` prints, and pictures of plan, windows and errors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from mmpi_ns.placement.errors import WORST, pixel_errors
from mmpi_ns.placement.observations import Array, Observations, VisiblePoints
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan
from mmpi_ns.scene.windows import WindowedPlan

COLORS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#17becf", "#bcbd22", "#7f7f7f")
DRAWN_POINTS = 6000
DRAWN_PLANES = 12


@dataclass(frozen=True)
class PlanReport:
    """Shares and expected errors of the K heads of a plan (MPIs, then the cube), over the weighted observations."""

    shares: Array
    """[K] share of the observations that a head serves best."""
    error_with: Array
    """[K] expected error of those, median in pixels."""
    error_without: Array
    """[K] the same without the head."""
    unserved: float
    """Share of the observations that no head contains."""
    overlap: float
    """Mean number of heads that contain an observation."""
    best: NDArray[np.int64]
    """[Q] head that serves each observation best,"""
    served_errors: Array
    """[Q] and its expected pixel error there; ``WORST`` where none contains it."""


def explain(plan: ScenePlan, observations: Observations, visible: VisiblePoints) -> PlanReport:
    """Shares and expected errors of every head, over the weighted observations."""
    errors = pixel_errors(plan, observations, visible.cameras, visible.points).combined
    combined, weights = np.minimum(errors, WORST), visible.weights / visible.weights.sum()
    held, best, figures = np.isfinite(errors), errors.argmin(-1), np.full((3, plan.num_heads), np.nan)
    for k in range(plan.num_heads):
        served = (best == k) & held.any(-1)
        rest = np.delete(combined[served], k, axis=1).min(-1, initial=WORST)
        figures[0, k] = weights[served].sum()
        if served.any():
            figures[1:, k] = np.median(combined[served, k]), np.median(rest)
    shares, error_with, error_without = figures
    unserved, overlap = float(weights[~held.any(-1)].sum()), float(held.sum(-1) @ weights)
    return PlanReport(shares, error_with, error_without, unserved, overlap, best, combined.min(-1))


def table(plan: ScenePlan, observations: Observations, report: PlanReport) -> str:
    """The report as a Markdown table and a line about the whole."""
    lines = [
        "| MPI | faces | origin | depths | tangents | planes x rows x columns | M texels "
        "| serves | error px | without |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    heads: list[MPIPlan | CubePlan] = [*plan.mpis, *([plan.cube] if plan.cube else [])]
    for k, head in enumerate(heads):
        if isinstance(head, MPIPlan):
            facing = describe_facing(np.asarray(head.axes[2]), observations.mean_axes)
            depths, size = f"{head.near:.3g} to {head.far:.3g}", (head.planes, head.height, head.width)
            origin, extent = head.origin, head.extent
        else:
            lower, upper = np.asarray(head.lower), np.asarray(head.upper)
            facing, depths, size = "all round", f"{(upper - lower).max() / 2:.3g}", head.shape
            origin, extent = (lower + upper) / 2, (*head.lower, *head.upper)
        numbers = ", ".join(f"{x:.3g}" for x in origin), depths, ", ".join(f"{x:.2f}" for x in extent)
        errors = f"{report.error_with[k]:.2f}", f"{report.error_without[k]:.2f}"
        figures = " x ".join(map(str, size)), f"{head.texels / 1e6:.2f}", f"{100 * report.shares[k]:.0f} %", *errors
        lines.append("| " + " | ".join((plan.names[k], facing, *numbers, *figures)) + " |")
    median, worst = np.percentile(report.served_errors, [50, 90])
    lines += [
        "",
        f"{plan.texels / 1e6:.2f} M texels in all. Expected error {median:.2f} px in the median, {worst:.2f} px at "
        f"nine tenths; {100 * report.unserved:.1f} % of what the cameras saw lies in no MPI. "
        f"A point lies in {report.overlap:.1f} of them on average.",
    ]
    return "\n".join(lines)


def describe_facing(direction: Array, base: Array) -> str:
    """Name of a direction in a frame of rows right, down, forward: the nearest of six, and degrees off it."""
    names = ("right", "below", "front", "left", "above", "back")
    along = np.concatenate([base @ direction, -(base @ direction)])
    nearest = int(along.argmax())
    angle = float(np.degrees(np.arccos(np.clip(along[nearest], -1, 1))))
    return names[nearest] if angle < 10 else f"{names[nearest]}, {angle:.0f} deg off"


def draw_plan(path: Path, plan: ScenePlan, observations: Observations, visible: VisiblePoints) -> None:
    """Writes a picture (PNG) of cameras, points, frusta and planes, from above and from the side.

    The picture's axes are the cameras' mean right, up and forward, in scene units.
    """
    base = observations.mean_axes * np.array([[1.0], [-1.0], [1.0]])  # right, up, forward
    middle = observations.centers.mean(0)
    # Far planes are left out: they would shrink everything else to a dot.
    distance = np.linalg.norm(visible.points - observations.centers[visible.cameras], axis=-1)
    points = visible.points[distance < 40 * visible.near]
    points = (points[:: max(1, len(points) // DRAWN_POINTS)] - middle) @ base.T
    centers = (observations.centers - middle) @ base.T
    low, high = np.percentile(points, [1, 99], axis=0) if len(points) else (centers.min(0), centers.max(0))
    low, high = np.minimum(low, centers.min(0)), np.maximum(high, centers.max(0))
    reach = float(np.linalg.norm(high - low))
    low, high = low - 0.05 * reach, high + 0.05 * reach
    facing = -observations.camera_to_worlds[:, :, 2] @ base.T * 0.025 * reach
    figure = Figure(figsize=(13, 8), layout="constrained")
    # Forward to the right in both, so that a drive fills the width; seen from above, left is then up.
    for row, (title, up, name) in enumerate((("from above", 0, "left"), ("from the side", 1, "up"))):
        sign = -1.0 if up == 0 else 1.0
        flip = np.array([[0.0, 0.0, 1.0], sign * np.eye(3)[up]])
        heights = sorted((sign * low[up], sign * high[up]))
        axes = figure.add_subplot(2, 1, row + 1, aspect="equal", title=title, xlabel="forward", ylabel=name)
        axes.scatter(*(points @ flip.T).T, s=2, c="0.75", linewidths=0, zorder=1)
        for k, mpi in enumerate(plan.mpis):
            _draw_mpi(axes, mpi, flip @ base, middle, reach, COLORS[k % len(COLORS)])
        if plan.cube is not None:
            steps = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
            pairs = [(i, j) for i in range(8) for j in range(i) if np.abs(steps[i] - steps[j]).sum() == 1]
            corners = plan.cube.lower + steps * np.subtract(plan.cube.upper, plan.cube.lower)
            edges = ((corners - middle) @ (flip @ base).T)[pairs]
            axes.add_collection(LineCollection(list(edges), colors="black", linewidths=0.8, zorder=3, label="cube"))
        axes.scatter(*(centers @ flip.T).T, s=10, c="black", zorder=4)
        looks = np.stack([centers, centers + facing], 1) @ flip.T
        axes.add_collection(LineCollection(list(looks), colors="black", linewidths=0.7, zorder=4))
        axes.set_xlim(low[2], high[2])
        axes.set_ylim(*heights)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=110)


def draw_windows(path: Path, windows: WindowedPlan, observations: Observations) -> None:
    """Writes a map (PNG) of a long capture: cameras, windows with their margins, origins and directions of MPIs."""
    base = observations.mean_axes
    map_axes = np.stack([base[2], -base[0]])  # forward to the right, left up
    middle = observations.centers.mean(0)
    centers = (observations.centers - middle) @ map_axes.T
    figure = Figure(figsize=(13, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal", title="windows, from above", xlabel="forward", ylabel="left")
    points = (observations.points[:: max(1, len(observations.points) // DRAWN_POINTS)] - middle) @ map_axes.T
    axes.scatter(*points.T, s=1, c="0.8", linewidths=0)
    for i, window in enumerate(windows.windows):
        color = COLORS[i % len(COLORS)]
        at = (np.asarray(window.center) - middle) @ map_axes.T
        axes.add_patch(Circle(at, window.radius, fill=False, color=color, label=f"window {i}"))
        axes.add_patch(Circle(at, window.radius + window.margin, fill=False, color=color, linestyle=":"))
        for mpi in window.plan.mpis:
            origin = (np.asarray(mpi.origin) - middle) @ map_axes.T
            ahead = np.asarray(mpi.axes[2]) @ map_axes.T * 0.4 * window.radius
            axes.annotate("", origin + ahead, origin, arrowprops={"arrowstyle": "->", "color": color})
    axes.scatter(*centers.T, s=6, c="black", zorder=4)
    reach = 0.6 * max(w.radius for w in windows.windows)
    axes.set_xlim(centers[:, 0].min() - reach, centers[:, 0].max() + reach)
    axes.set_ylim(centers[:, 1].min() - reach, centers[:, 1].max() + reach)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=110)


def draw_errors(path: Path, plan: ScenePlan, report: PlanReport) -> None:
    """Writes a histogram (PNG) of the expected pixel error, coloured by the MPI that serves each observation."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.add_subplot(xlabel="expected error, pixels", ylabel="observations", xscale="log")
    errors, bins = report.served_errors, np.geomspace(0.1, WORST, 49)
    values = [np.clip(errors[report.best == k], bins[0], WORST) for k in range(len(plan.names))]
    colors = [COLORS[k % len(COLORS)] if k < len(plan.mpis) else "black" for k in range(len(plan.names))]
    axes.hist(values, bins=bins.tolist(), stacked=True, color=colors, label=list(plan.names))
    axes.axvline(float(np.median(errors)), color="black", linestyle="--", linewidth=0.8)
    axes.set_title(f"median {np.median(errors):.2f} px; what nothing holds counts {WORST:.0f} px")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=110)


def _draw_mpi(axes: Axes, mpi: MPIPlan, picture: Array, middle: Array, reach: float, color: str) -> None:
    """Outline of a frustum and some planes up to ``reach``, in a picture of two world axes (rows) about ``middle``."""
    u0, u1, v0, v1 = mpi.extent
    origin = (np.asarray(mpi.origin) - middle) @ picture.T
    shares = np.linspace(0, 1, min(DRAWN_PLANES, mpi.planes), endpoint=False)
    depths = mpi.near / (1 - mpi.depth_share * shares)
    end = min(mpi.far, reach)
    depths = np.append(depths[depths < end], end)
    corners = np.array([[u, v, 1.0] for u in (u0, u1) for v in (v0, v1)]) @ np.asarray(mpi.axes) @ picture.T
    # Of a plane the two corners that lie farthest apart in the picture.
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    diagonal = corners[list(np.unravel_index(int(apart.argmax()), apart.shape))]
    planes = np.array([origin + depth * diagonal for depth in depths])
    axes.add_collection(LineCollection(list(planes), colors=color, linewidths=0.6, zorder=2))
    borders = [np.stack([origin, end]) for end in planes[-1]]
    axes.add_collection(LineCollection(borders, colors=color, linewidths=1.2, zorder=2, label=mpi.name))
    axes.plot(*origin, marker="x", color=color, zorder=5)
