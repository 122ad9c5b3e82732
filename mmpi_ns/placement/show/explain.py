"""What a plan does for a scene, head by head: the table that ``mmpi-plan`` prints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mmpi_ns.placement.errors import WORST, PixelErrors, pixel_errors
from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.placement.visibility import VisiblePoints
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan


@dataclass(frozen=True)
class PlanReport:
    """Shares and expected errors of the K heads of a plan (MPIs, then the cube), over what placement weighs."""

    shares: Array
    """[K] share of the observations that a head serves best."""
    error_with: Array
    """[K] expected error of those, median in pixels."""
    error_without: Array
    """[K] the same if the head were left out."""
    unserved: float
    """Share of the observations that nothing holds."""
    overlap: float
    """Heads that hold an observation, on average."""
    errors: PixelErrors

    @property
    def served_errors(self) -> Array:
        """[Q] expected pixel error of each observation in the head that serves it best; ``WORST`` where none does."""
        return np.minimum(self.errors.combined.min(-1), WORST)


def explain(plan: ScenePlan, observations: Observations, visible: VisiblePoints) -> PlanReport:
    """Shares and expected errors of every head, over the observations that placement weighs."""
    errors = pixel_errors(plan, observations, visible.cameras, visible.points)
    combined, weights = np.minimum(errors.combined, WORST), visible.weights / visible.weights.sum()
    held, figures = np.isfinite(errors.combined), np.full((3, plan.num_heads), np.nan)
    for k in range(plan.num_heads):
        served = (errors.best == k) & held.any(-1)
        rest = np.delete(combined[served], k, axis=1).min(-1, initial=WORST)
        figures[0, k] = weights[served].sum()
        if served.any():
            figures[1:, k] = np.median(combined[served, k]), np.median(rest)
    shares, error_with, error_without = figures
    unserved, overlap = float(weights[~held.any(-1)].sum()), float(held.sum(-1) @ weights)
    return PlanReport(shares, error_with, error_without, unserved, overlap, errors)


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
    """Which way a direction points in a frame of rows right, down, forward: the nearest of six, and degrees off it."""
    names = ("right", "below", "front", "left", "above", "back")
    along = np.concatenate([base @ direction, -(base @ direction)])
    nearest = int(along.argmax())
    angle = float(np.degrees(np.arccos(np.clip(along[nearest], -1, 1))))
    return names[nearest] if angle < 10 else f"{names[nearest]}, {angle:.0f} deg off"
