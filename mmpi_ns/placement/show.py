"""Report of a plan: the table that ``mmpi-plan`` prints, and a picture of the plan from above."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

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
    served_errors: Array
    """[Q] expected pixel error of each observation in the head that serves it best; ``WORST`` where none contains
    it."""


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
    return PlanReport(shares, error_with, error_without, unserved, overlap, combined.min(-1))


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


def draw_plan(path: Path, windows: WindowedPlan, observations: Observations) -> None:
    """Writes a picture (PNG) from above: cameras (black), points (grey), frusta and some planes of the MPIs, and the
    cubes. The cameras' mean forward is to the right; windows have one colour each, or the MPIs of a single window."""
    right, _, forward = observations.mean_axes
    axes_of_map, middle = np.stack([forward, -right]), observations.centers.mean(0)
    points = observations.points[:: max(1, len(observations.points) // DRAWN_POINTS)]
    points, centers = ((x - middle) @ axes_of_map.T for x in (points, observations.centers))
    low, high = np.percentile(points, [2, 98], axis=0) if len(points) else (centers.min(0), centers.max(0))
    low, high = np.minimum(low, centers.min(0)), np.maximum(high, centers.max(0))
    reach = float(np.linalg.norm(high - low))
    figure = Figure(figsize=(13, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal", title="from above", xlabel="forward", ylabel="left")
    axes.scatter(*points.T, s=2, c="0.75", linewidths=0, zorder=1)
    for w, window in enumerate(windows.windows):
        length = min(reach, 2 * window.radius) if len(windows) > 1 else reach
        for k, mpi in enumerate(window.plan.mpis):
            corner, planes = frustum_from_above(mpi, axes_of_map, middle, length)
            number, name = (w, f"window {w}" if k == 0 else None) if len(windows) > 1 else (k, mpi.name)
            color = COLORS[number % len(COLORS)]
            axes.add_collection(LineCollection(list(planes), colors=color, linewidths=0.6, zorder=2))
            borders = [np.stack([corner, end]) for end in planes[-1]]
            axes.add_collection(LineCollection(borders, colors=color, linewidths=1.2, zorder=2, label=name))
        if (cube := window.plan.cube) is not None:
            steps = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
            edges = [(i, j) for i in range(8) for j in range(i) if np.abs(steps[i] - steps[j]).sum() == 1]
            corners = (cube.lower + steps * np.subtract(cube.upper, cube.lower) - middle) @ axes_of_map.T
            axes.add_collection(LineCollection(list(corners[edges]), colors="black", linewidths=0.8, label="cube"))
    axes.scatter(*centers.T, s=8, c="black", zorder=4)
    axes.set_xlim(low[0] - 0.05 * reach, high[0] + 0.05 * reach)
    axes.set_ylim(low[1] - 0.05 * reach, high[1] + 0.05 * reach)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=110)


def frustum_from_above(mpi: MPIPlan, axes_of_map: Array, middle: Array, reach: float) -> tuple[Array, Array]:
    """Origin [2] of an MPI and the ends of some planes [P, 2, 2] up to ``reach``, in a map with these axes [2, 3]."""
    u0, u1, v0, v1 = mpi.extent
    depths = mpi.near / (1 - mpi.depth_share * np.linspace(0, 1, min(DRAWN_PLANES, mpi.planes), endpoint=False))
    end = min(mpi.far, reach)
    depths = np.append(depths[depths < end], end)
    corners = np.array([[u, v, 1.0] for u in (u0, u1) for v in (v0, v1)]) @ np.asarray(mpi.axes) @ axes_of_map.T
    # Of a plane the two corners that lie farthest apart on the map.
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    diagonal = corners[list(np.unravel_index(int(apart.argmax()), apart.shape))]
    origin = (np.asarray(mpi.origin) - middle) @ axes_of_map.T
    return origin, origin + depths[:, None, None] * diagonal
