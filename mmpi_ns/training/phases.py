"""Phase, trainable parameters, resolution and learning rates, as pure functions of the step.

The schedule is fixed before step 0 and stored in the checkpoint, so that a resumed run follows the same schedule.
Source: paper sec. III-C ("two-stage reliability learning scheme") and sec. IV (30k + 10k steps).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from itertools import accumulate, pairwise

from mmpi_ns.settings import ScheduleConfig
from mmpi_ns.training.reliability import TRAINS, phase_lengths
from mmpi_ns.utils.errors import InputError

GROWING_SHARE, FULL_STEPS = 0.5, 1250
"""Share of the batch drawn while texels grow from initial surfaces, when rays cost most and coarse texels need few.
Runs of at most so many steps draw all; longer ones draw at least as many rays in total (docs/ablations.md)."""
MOST_GROWING = 4000
"""Steps that ``growth_shares`` are of in a longer first phase with depth priors: surfaces need no more to form."""
LATER = 1.5
"""Factor on ``growth_shares`` with depth priors where cameras do not look along their path: coarse texels extend
surfaces beyond the borders of the training images."""
COARSE_PIXELS, SOONER = 16.0, 4.0
"""Where they do, texels that span more pixels double ``SOONER`` times as early: near surfaces that few images show are
lost in such texels (docs/ablations.md)."""
COPIES_FROM = 0.75
"""Share of the period of high learning rates after which MPIs may get finer copies."""


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
    windows: int = 1
    """Windows of a long capture, which follow this schedule one after the other."""
    release: tuple[int, ...] = ()
    """Steps before which empty bricks are released, judging by the samples since the previous such step or the last
    growth."""
    growing_share: float = 1.0
    """Share of the batch that a step draws until surfaces have formed (``sharpened``)."""
    formed: int = 0
    """Step from which surfaces count as formed."""

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

    def texel_factor(self, step: int) -> float:
        """Share of the plan's texels in use at this step, a power of two."""
        return 2.0 ** -sum(self._local(step) < g for g in self.growth)

    def sharpened(self, step: int) -> bool:
        """Whether surfaces have formed, so that all samples of little weight are dropped."""
        return self._local(step) >= self.formed

    @property
    def _grown(self) -> int:
        """Step from which resolution has stopped growing (without growth: a tenth of the first phase)."""
        return self.growth[-1] if self.growth else self.phases[0].end // 10

    def releases_at(self, step: int) -> bool:
        """Whether bricks are released before this step."""
        return self._local(step) in self.release

    def refines_at(self, step: int, copies: bool = False) -> bool:
        """Whether texels may become finer than planned before this step: at releases after the last growth, as long as
        rates are high. ``copies``: whether MPIs may get finer copies, which wait until all texels had time to."""
        high = round(self.decay_from * self.phases[0].end)  # rounded as releases are
        is_high = max(self._grown, COPIES_FROM * high if copies else 0) < self._local(step) <= high
        return is_high and self.releases_at(step)

    def watches(self, step: int) -> bool:
        """Whether the samples of a step count for the next release of bricks."""
        if not self.release:
            return False
        # From when on the texels have the size that they have before the first release.
        first = max([s for s in self.growth if s < self.release[0]], default=0) if self.growth else self._grown
        return first <= self._local(step) < self.release[-1]

    def rate_factor(self, kind: str, step: int) -> float:
        """Learning rate of a parameter kind relative to its start value; 0 where it is frozen."""
        phase = self.phase_at(step)
        return self.decay(step) if kind in TRAINS[phase.name] else 0.0

    def decay(self, step: int) -> float:
        """What rates have fallen to at a step, relative to the start of its phase."""
        phase = self.phase_at(step)
        progress = (step - phase.start) / max(1, phase.end - phase.start)
        falls = (min(progress, 1.0) - self.decay_from) / (1 - self.decay_from)
        return float(10.0 ** (-self.decay_decades * max(falls, 0.0)))

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> Schedule:
        data = json.loads(text)
        phases = tuple(Phase(**p) for p in data.pop("phases"))
        lists = {name: tuple(data.pop(name, ())) for name in ("growth", "release")}
        return Schedule(phases=phases, **lists, **data)


def make_schedule(
    config: ScheduleConfig,
    total_steps: int,
    windows: int = 1,
    has_depths: bool = False,
    along_path: bool = False,
    texel_pixels: float = 0.0,
) -> Schedule:
    """The schedule of a run; nothing is released before texels have doubled.

    Args:
        config: options.
        total_steps: of a window.
        windows: of the capture.
        has_depths: training starts with surfaces (``initial.py``).
        along_path: cameras look along their path.
        texel_pixels: pixels that a texel of the plan spans.

    Raises:
        InputError: no step is left for the first phase, growth goes backwards, or rates never fall.
    """
    if total_steps < 1:
        raise InputError(f"Training needs at least 1 step, got {total_steps}: raise --max-num-iterations.")
    check_schedule(config)
    lengths = {"joint": total_steps}
    if config.training == "two-phase":
        lengths = phase_lengths(total_steps, config.blend_share, config.finetune_share)
    ends = accumulate(lengths.values())
    phases = tuple(Phase(name, end - n, end) for (name, n), end in zip(lengths.items(), ends, strict=True) if n > 0)
    first = phases[0].end
    growing = min(first, MOST_GROWING) if has_depths else first
    later = LATER if has_depths and not along_path else 1.0
    shares = tuple(min(later * s, 1.0) for s in config.growth_shares)
    doublings = sooner_if_coarse(shares, texel_pixels) if has_depths and along_path else shares
    growth = tuple(max(1, round(s * growing)) for s in doublings)
    rates = float(config.decay_decades), float(config.decay_from)
    part = min(1.0, max(GROWING_SHARE, FULL_STEPS / total_steps)) if has_depths else 1.0
    schedule = Schedule(phases, growth, *rates, windows, growing_share=part)
    doubling = dict(zip(config.growth_shares, shares, strict=True))
    release = [round(doubling[s] * growing if s in doubling else s * first) for s in config.release_shares]
    release = sorted(set(release)) if config.release_weight > 0 else []
    # A release at a growth step comes before it, so that less grows.
    formed = schedule._grown
    if has_depths and shares:
        formed = max(1, round(shares[(len(shares) - 1) // 2] * growing))
    return replace(schedule, release=tuple(s for s in release if s > schedule._grown or s in growth), formed=formed)


def sooner_if_coarse(shares: tuple[float, ...], texel_pixels: float) -> tuple[float, ...]:
    """The shares at which texels double until they span ``texel_pixels``: the first ones, ``SOONER`` times as early,
    while they span more than ``COARSE_PIXELS``, and then again the first ones."""
    count = len(shares)
    coarse = sum(texel_pixels * 2 ** (n / 2) > COARSE_PIXELS for n in range(1, count + 1))
    return (*(s / SOONER for s in shares[:coarse]), *shares[: count - coarse])


def check_schedule(config: ScheduleConfig) -> None:
    """Raises InputError naming the options that leave no schedule."""
    option = "--pipeline.model.schedule."
    if config.training == "two-phase" and config.blend_share + config.finetune_share >= 1:
        raise InputError(
            f"{option}blend-share and finetune-share leave no steps for the first phase: give less than 1."
        )
    if any(a > b for a, b in pairwise(config.growth_shares)):
        raise InputError(f"{option}growth-shares must not decrease.")
    if config.decay_from == 1:
        raise InputError(f"{option}decay-from must be less than 1.")
