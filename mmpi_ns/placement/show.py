"""Report of a plan: the table that ``mmpi-plan`` prints, and a picture of the plan from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from mmpi_ns.placement.errors import WORST, pixel_errors
from mmpi_ns.placement.observations import Array, Observations, find_visible_points
from mmpi_ns.placement.split import cameras_of, of_cameras
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan
from mmpi_ns.scene.windows import WindowedPlan

DRAWN_POINTS = 6000
DRAWN_PLANES = 12


def explain(windows: WindowedPlan, observations: Observations) -> str:
    """The tables of a plan: for each window, over the observations of its own cameras."""
    parts = []
    for i, window in enumerate(windows.windows):
        part = of_cameras(observations, cameras_of(window, observations.centers))
        title = f"## Window {i}: {len(part.centers)} training cameras\n\n" if len(windows) > 1 else ""
        rule = window.plan.origin_of_plan
        parts.append(f"{title}{table(window.plan, part)}\n\n{rule[0].upper()}{rule[1:]}.")
    if len(windows) > 1:
        total = sum(plan.texels for plan in windows.plans) / 1e6
        parts.append(f"{len(windows)} windows, {total:.2f} M texels in all.")
    return "\n\n".join(parts)


def table(plan: ScenePlan, observations: Observations) -> str:
    """Shares and expected errors of every head, over the weighted observations, as a Markdown table, and a line about
    the whole."""
    visible = find_visible_points(observations)
    errors = pixel_errors(plan, observations, visible.cameras, visible.points)
    combined, weights = np.minimum(errors, WORST), visible.weights / visible.weights.sum()
    held, best = np.isfinite(errors), errors.argmin(-1)
    lines = [
        "| MPI | faces | origin | depths | tangents | planes x rows x columns | M texels "
        "| serves | error px | without |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    heads: list[MPIPlan | CubePlan] = [*plan.mpis, *([plan.cube] if plan.cube else [])]
    for k, head in enumerate(heads):
        served = (best == k) & held.any(-1)
        rest = np.delete(combined[served], k, axis=1).min(-1, initial=WORST)
        medians = [f"{np.median(x):.2f}" if served.any() else "-" for x in (combined[served, k], rest)]
        if isinstance(head, MPIPlan):
            facing = describe_facing(np.asarray(head.axes[2]), observations.mean_axes)
            size, depths = (head.planes, head.height, head.width), f"{head.near:.3g} to {head.far:.3g}"
            frame = ", ".join(f"{x:.3g}" for x in head.origin), depths, ", ".join(f"{x:.2f}" for x in head.extent)
        else:
            facing, size, frame = "all round", head.shape, ("-", "-", "-")
        figures = " x ".join(map(str, size)), f"{head.texels / 1e6:.2f}", f"{100 * weights[served].sum():.0f} %"
        lines.append("| " + " | ".join((plan.names[k], facing, *frame, *figures, *medians)) + " |")
    median, worst = np.percentile(combined.min(-1), [50, 90])
    return "\n".join(lines) + (
        f"\n\n{plan.texels / 1e6:.2f} M texels in all. Expected error {median:.2f} px in the median, {worst:.2f} px at "
        f"nine tenths; {100 * weights[~held.any(-1)].sum():.1f} % of what the cameras saw lies in no MPI. "
        f"A point lies in {held.sum(-1) @ weights:.1f} of them on average."
    )


def describe_facing(direction: Array, base: Array) -> str:
    """Name of a direction in a frame of rows right, down, forward: the nearest of six, and degrees off it."""
    names = ("right", "below", "front", "left", "above", "back")
    along = np.concatenate([base @ direction, -(base @ direction)])
    nearest = int(along.argmax())
    angle = float(np.degrees(np.arccos(np.clip(along[nearest], -1, 1))))
    return names[nearest] if angle < 10 else f"{names[nearest]}, {angle:.0f} deg off"


def draw_plan(path: Path, windows: WindowedPlan, observations: Observations) -> None:
    """Writes a picture (PNG) from above: cameras (black), points (grey), frusta and some planes of the MPIs. The
    cameras' mean forward is to the right; windows have one colour each, or the MPIs of a single window."""
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
            lines = [*planes, *(np.stack([corner, end]) for end in planes[-1])]
            axes.add_collection(LineCollection(lines, colors=f"C{number % 10}", linewidths=0.8, zorder=2, label=name))
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
