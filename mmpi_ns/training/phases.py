"""Phase, trainable parameters, resolution and learning rates, as pure functions of the step.

The schedule is fixed before step 0 and stored in the checkpoint, so that a resumed run follows the same schedule.
Source: paper sec. III-C ("two-stage reliability learning scheme") and sec. IV (30k + 10k steps).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Literal

PhaseName = Literal["individual", "blend", "finetune", "joint"]
ParameterKind = Literal["density", "features", "colour", "reliability", "camera_opt"]
Training = Literal["two-phase", "joint"]

LONG_RUN = 4000
"""Steps from which on the rays while the texels grow are more than enough."""
TRAINS: dict[str, frozenset[str]] = {
    "individual": frozenset({"density", "features", "colour", "camera_opt"}),
    "joint": frozenset({"density", "features", "colour", "camera_opt"}),
    "blend": frozenset({"reliability"}),
    "finetune": frozenset({"density", "features", "colour", "reliability", "camera_opt"}),
}
"""Trainable parameters of each phase; everything else is frozen bit for bit."""


@dataclass(frozen=True)
class Phase:
    name: str
    start: int
    end: int
    """One past the phase's last step."""


@dataclass(frozen=True)
class Schedule:
    """Phases that follow each other, resolution growth, and learning-rate decay."""

    phases: tuple[Phase, ...]
    growth: tuple[int, ...]
    """Steps at which the texels of a plane double; before the first they are 2^-len(growth) of the plan's."""
    decay_decades: float
    """Learning rates fall by 10^-decay_decades over the rest of a phase,"""
    decay_from: float
    """after being constant for this fraction of it."""
    finetune_rate: float
    """Learning rates at the start of the fine-tune, relative to those of the first phase."""
    windows: int = 1
    """Windows of a long capture, which follow this schedule one after the other."""
    release: tuple[int, ...] = ()
    """Steps before which empty bricks are released, judging by the samples since the previous such step or the last
    growth."""
    growing_rays: float = 1.0
    """Fraction of a step's rays that are drawn until surfaces have formed."""

    @property
    def is_joint(self) -> bool:
        """Whether all MPIs train together from the start, each with 1/K of the optical depth."""
        return self.phases[0].name == "joint"

    @property
    def window_steps(self) -> int:
        return self.phases[-1].end

    @property
    def total_steps(self) -> int:
        return self.window_steps * self.windows

    def window_at(self, step: int) -> int:
        """The window that an absolute step trains; the last one after the end."""
        return min(step // self.window_steps, self.windows - 1)

    def _local(self, step: int) -> int:
        return step - self.window_at(step) * self.window_steps

    def phase_at(self, step: int) -> Phase:
        """The phase of an absolute step; the last phase after its end (evaluation after training)."""
        first = self.window_at(step) * self.window_steps
        chosen = next((phase for phase in self.phases if step - first < phase.end), self.phases[-1])
        return Phase(chosen.name, chosen.start + first, chosen.end + first)

    def blends_at(self, step: int) -> bool:
        """Whether reliability takes part in rendering at this step."""
        return self.phase_at(step).name in ("blend", "finetune")

    def texel_factor(self, step: int) -> float:
        """Share of the plan's texels in use at this step, a power of two."""
        return 2.0 ** -sum(self._local(step) < g for g in self.growth)

    def sharpened(self, step: int) -> bool:
        """Whether surfaces have formed: resolution has stopped growing (without growth: a tenth of the first phase)."""
        return self._local(step) >= self._sharp_from

    @property
    def _sharp_from(self) -> int:
        return self.growth[-1] if self.growth else self.phases[0].end // 10

    def rays_share(self, step: int) -> float:
        """Share of the rays of a step that are drawn."""
        return 1.0 if self.sharpened(step) else self.growing_rays

    def releases_at(self, step: int) -> bool:
        """Whether bricks are released before this step."""
        return self._local(step) in self.release

    def watches(self, step: int) -> bool:
        """Whether the samples of a step count for the next release of bricks."""
        return bool(self.release) and self._watched_from <= self._local(step) < self.release[-1]

    @property
    def _watched_from(self) -> int:
        """The texels have the size that they have before the first release."""
        return max([s for s in self.growth if s < self.release[0]], default=0) if self.growth else self._sharp_from

    def rate_factor(self, kind: str, step: int) -> float:
        """Learning rate of a parameter kind relative to its start value; 0 where it is frozen."""
        phase = self.phase_at(step)
        if kind not in TRAINS[phase.name]:
            return 0.0
        progress = (step - phase.start) / max(1, phase.end - phase.start)
        falls = (min(progress, 1.0) - self.decay_from) / (1 - self.decay_from)
        base = self.finetune_rate if phase.name == "finetune" else 1.0
        return float(base * 10.0 ** (-self.decay_decades * max(falls, 0.0)))

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> Schedule:
        data = json.loads(text)
        phases = tuple(Phase(**p) for p in data.pop("phases"))
        lists = {name: tuple(data.pop(name, ())) for name in ("growth", "release")}
        return Schedule(phases=phases, **lists, **data)


def make_schedule(
    training: Training,
    total_steps: int,
    *,
    blend_share: float = 0.25,
    finetune_share: float = 0.0,
    growth_shares: tuple[float, ...] = (1 / 15, 2 / 15, 3 / 15, 4 / 15),
    decay_decades: float = 1.5,
    decay_from: float = 0.0,
    finetune_rate: float = 0.1,
    windows: int = 1,
    release_shares: tuple[float, ...] = (),
    growing_rays: float = 1.0,
) -> Schedule:
    """The schedule of a run of ``total_steps`` steps a window.

    Args:
        training: ``two-phase`` (individual, blend, optional fine-tune) or ``joint`` (all MPIs at once, no reliability).
        total_steps: all steps of a window.
        blend_share: share of the steps in which only reliability trains (two-phase).
        finetune_share: share of the steps in which everything trains together at the end (two-phase).
        growth_shares: when texels double, as shares of the first phase.
        decay_decades: decades that learning rates fall over a phase (paper: x0.1 per 20k of 30k steps = 1.5).
        decay_from: fraction of a phase for which they are constant before that.
        finetune_rate: learning rates at the start of the fine-tune relative to the first phase's.
        windows: windows of a long capture, trained one after the other.
        release_shares: when empty bricks are released, as fractions of the first phase; not before surfaces have
            formed.
        growing_rays: fraction of a step's rays that are drawn until then; proportionally more in runs of fewer than
            ``LONG_RUN`` steps, which would see too few.

    Raises:
        ValueError: the shares leave no step for the first phase.
    """
    if total_steps < 1:
        raise ValueError(f"Training needs at least 1 step, got {total_steps}: raise --max-num-iterations.")
    lengths: list[tuple[str, int]]
    if training == "joint":
        lengths = [("joint", total_steps)]
    else:
        if min(blend_share, finetune_share) < 0:
            raise ValueError("blend-share and finetune-share must not be negative.")
        if blend_share + finetune_share >= 1:
            raise ValueError("blend-share + finetune-share leave no step for the individual phase: lower them.")
        # The first phase has at least one step, even if rounding up the others would take all of them.
        blend = min(round(total_steps * blend_share), total_steps - 1)
        finetune = min(round(total_steps * finetune_share), total_steps - 1 - blend)
        lengths = [("individual", total_steps - blend - finetune), ("blend", blend), ("finetune", finetune)]
    lengths = [(name, n) for name, n in lengths if n > 0]
    ends = [sum(n for _, n in lengths[: i + 1]) for i in range(len(lengths))]
    phases = tuple(Phase(name, end - n, end) for (name, n), end in zip(lengths, ends, strict=True))
    growth = tuple(max(1, round(s * phases[0].end)) for s in growth_shares)
    if any(a > b for a, b in pairwise(growth)):
        raise ValueError("growth-shares must not decrease.")
    if not 0 <= decay_from < 1:
        raise ValueError(f"decay-from must lie between 0 and 1, 1 excluded, got {decay_from}.")
    rates = float(decay_decades), float(decay_from), float(finetune_rate)
    few = min(1.0, float(growing_rays) * max(1.0, LONG_RUN / total_steps))
    schedule = Schedule(phases, growth, *rates, windows, growing_rays=few)
    release = sorted({round(s * phases[0].end) for s in release_shares})
    # A release at a growth step comes before it, so that less grows.
    return replace(schedule, release=tuple(s for s in release if s > schedule._sharp_from or s in growth))
