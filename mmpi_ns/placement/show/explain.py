"""What a plan does for a scene, head by head: the table that ``mmpi-plan`` prints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mmpi_ns.placement.errors import WORST, PixelErrors, pixel_errors
from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.placement.visibility import VisiblePoints
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan


@dataclass(frozen=True)
class HeadReport:
    """One head of a plan."""

    name: str
    facing: str
    """Relative to the cameras' mean direction and gravity: 'front', 'left', 'front-right 35', ..."""
    origin: tuple[float, ...]
    near: float
    """Depth of the first plane; half the side of a cube."""
    far: float
    """Depth of the last plane; not a number for a cube."""
    extent: tuple[float, ...]
    """Tangents (u0, u1, v0, v1); the box of a cube."""
    size: tuple[int, ...]
    """Planes, rows, columns."""
    texels: int
    share: float
    """Of the observations, those that this head serves best."""
    error_with: float
    """Expected error of those, median in pixels."""
    error_without: float
    """The same if this head were left out."""


@dataclass(frozen=True)
class PlanReport:
    """A whole plan."""

    heads: tuple[HeadReport, ...]
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
    combined = np.minimum(errors.combined, WORST)
    best, weights = errors.best, visible.weights
    held = np.isfinite(errors.combined)
    heads: list[MPIPlan | CubePlan] = [*plan.mpis, *([plan.cube] if plan.cube else [])]
    reports = []
    for k, head in enumerate(heads):
        served = (best == k) & held.any(-1)
        rest = np.delete(combined[served], k, axis=1).min(-1, initial=WORST)
        share = float(weights[served].sum() / weights.sum())
        figures = head.texels, share, _median(combined[served, k]), _median(rest)
        if isinstance(head, MPIPlan):
            facing = describe_facing(np.asarray(head.axes[2]), observations.mean_axes)
            frame = facing, head.origin, head.near, head.far, head.extent, (head.planes, head.height, head.width)
        else:
            lower, upper = np.asarray(head.lower), np.asarray(head.upper)
            half, box = float((upper - lower).max() / 2), (*head.lower, *head.upper)
            frame = "all round", tuple((lower + upper) / 2), half, float("nan"), box, head.shape
        reports.append(HeadReport(plan.names[k], *frame, *figures))
    unserved = float(weights[~held.any(-1)].sum() / weights.sum())
    return PlanReport(tuple(reports), unserved, float(held.sum(-1) @ weights / weights.sum()), errors)


def table(report: PlanReport) -> str:
    """The report as a Markdown table and a line about the whole."""
    lines = [
        "| MPI | faces | origin | depths | tangents | planes x rows x columns | M texels "
        "| serves | error px | without |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for h in report.heads:
        cells = [
            h.name,
            h.facing,
            ", ".join(f"{x:.3g}" for x in h.origin),
            f"{h.near:.3g}" if np.isnan(h.far) else f"{h.near:.3g} to {h.far:.3g}",
            ", ".join(f"{x:.2f}" for x in h.extent),
            " x ".join(str(n) for n in h.size),
            f"{h.texels / 1e6:.2f}",
            f"{100 * h.share:.0f} %",
            f"{h.error_with:.2f}",
            f"{h.error_without:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    total = sum(h.texels for h in report.heads) / 1e6
    median, worst = np.percentile(report.served_errors, [50, 90])
    lines += [
        "",
        f"{total:.2f} M texels in all. Expected error {median:.2f} px in the median, {worst:.2f} px at nine tenths; "
        f"{100 * report.unserved:.1f} % of what the cameras saw lies in no MPI. "
        f"A point lies in {report.overlap:.1f} of them on average.",
    ]
    return "\n".join(lines)


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def describe_facing(direction: Array, base: Array) -> str:
    """Which way a direction points in a frame of rows right, down, forward: the nearest of six, and degrees off it."""
    names = ("right", "below", "front", "left", "above", "back")
    along = np.concatenate([base @ direction, -(base @ direction)])
    nearest = int(along.argmax())
    angle = float(np.degrees(np.arccos(np.clip(along[nearest], -1, 1))))
    return names[nearest] if angle < 10 else f"{names[nearest]}, {angle:.0f} deg off"
