"""What a run takes: told before it starts as far as it is known then, and during it as far as it was measured."""

from __future__ import annotations

import statistics
from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import chain

from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK, SIDE, head_shapes
from mmpi_ns.scene.visible_tiles import TrainingViews, reachable_tiles
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.training.phases import Schedule

GIB = 2**30
SKIPPED = 4
"""First steps that are not timed: inner loops are compiled in them and memory is touched for the first time."""
FEWEST = 16
"""Steps that a forecast rests on at least: total variation alone makes every fourth one longer."""


def training_bytes(plan: ScenePlan, views: TrainingViews | None, feature_channels: int, two_phase: bool) -> int:
    """Bytes of the tables of one window at full resolution, and of their moments; at most, as bricks may be given up.

    Args:
        plan: MPIs and cube.
        views: training images; what none can reach is not stored. None: everything is.
        feature_channels: colour features of a texel.
        two_phase: whether reliability is trained, so that it has moments.
    """
    tiles = sum(depth * -(-height // SIDE) * -(-width // SIDE) for depth, height, width in head_shapes(plan))
    stored = tiles if views is None else int(reachable_tiles(views, plan).sum())
    learned = 1 + feature_channels + two_phase
    numbers = 1 + feature_channels + 1 + 2 * learned  # density, features, reliability, two moments
    return (stored + 1) * (BRICK * (4 * numbers + 1) + 4) + 4 * tiles  # and what is touched, peaks, where tiles lie


def describe(windows: WindowedPlan, steps: int, tables: Sequence[int], pixels: Sequence[int]) -> str:
    """What will be trained, and what it takes.

    Args:
        windows: of the capture.
        steps: of each window.
        tables: ``training_bytes`` of each window.
        pixels: bytes of training pixels that are held while each window trains.
    """
    most = max(range(len(windows)), key=lambda w: tables[w] + pixels[w])
    memory = (
        f"Memory in training: at most {(tables[most] + pixels[most]) / GIB:.2f} GiB (tables and moments "
        f"{tables[most] / GIB:.2f}, pixels {pixels[most] / GIB:.2f}), beside the program and the work of a step."
    )
    time = "How long it takes is said as soon as some steps were timed."
    if len(windows) == 1:
        return "\n".join([*_describe_plan(windows.plans[0]), memory, time])
    texels = [plan.texels for plan in windows.plans]
    lines = [
        f"A long capture: {len(windows)} windows of {steps} steps each, one after the other; {sum(texels) / 1e6:.1f} M "
        f"texels on disk, at most {max(texels) / 1e6:.1f} M in training at a time."
    ]
    for i, window in enumerate(windows.windows):
        lines.append(f"Window {i}, cameras within {window.radius:.3g} (and {window.margin:.3g} more to mix):")
        lines += ["  " + line for line in _describe_plan(window.plan)]
    return "\n".join([*lines, memory, time])


def _describe_plan(plan: ScenePlan) -> list[str]:
    lines = [f"Scene plan ({plan.origin_of_plan}): {len(plan.mpis)} MPIs, {plan.texels / 1e6:.1f} M texels"]
    for m in plan.mpis:
        tangents = " ".join(f"{t:.2f}" for t in m.extent)
        lines.append(
            f"  {m.name}: {m.planes} planes of {m.height} x {m.width}, "
            f"depths {m.near:.3g} to {m.far:.3g}, tangents {tangents}"
        )
    if plan.cube is not None:
        lines.append(f"  cube: {' x '.join(str(n) for n in plan.cube.shape)} voxels")
    return lines


class Forecast:
    """Says how long the rest of a run takes, by what its own steps took.

    While resolution grows every sample must learn, later those that are seen; phases differ as well. So steps are
    timed by stages (phase, resolution, whether surfaces have formed), and stages that were not reached yet are
    taken to cost what the last one did. Whenever surfaces have formed or a phase has begun it is said anew.

    Args:
        schedule: of the run.
        spans: steps that this process runs, in their order: one range, or one for each of its windows.
    """

    def __init__(self, schedule: Schedule, spans: Sequence[range]) -> None:
        self.schedule, self.spans = schedule, tuple(spans)
        self._times: dict[tuple[str, float, bool], list[float]] = defaultdict(list)
        self._said: set[tuple[str, bool]] = set()
        self._seen = 0

    def note(self, step: int, seconds: float) -> str | None:
        """Takes down what a step took.

        Args:
            step: that has run.
            seconds: since the one before had.

        Returns:
            A sentence, where it is time for one.
        """
        self._seen += 1
        if self._seen <= SKIPPED:
            return None
        phase, factor, sharpened = stage = self._stage(step)
        self._times[stage].append(seconds)
        enough = max(FEWEST, self.schedule.window_steps // 100)
        if (phase, sharpened) in self._said or len(self._times[stage]) < enough:
            return None
        self._said.add((phase, sharpened))
        left = self.seconds_left(step)
        told = f"After step {step + 1:,}: about {duration(left)} to go"
        if factor < 1:
            told += f", if steps go on taking {self._typical(stage):.2g} s: said anew when resolution has grown"
        return told + "."

    def seconds_left(self, step: int) -> float:
        """Seconds that the steps after this one take."""
        at = next(i for i, span in enumerate(self.spans) if step in span)
        ahead = chain(range(step + 1, self.spans[at].stop), *self.spans[at + 1 :])
        counts, now = Counter(map(self._stage, ahead)), self._stage(step)
        return sum(n * self._typical(stage if self._times.get(stage) else now) for stage, n in counts.items())

    def _stage(self, step: int) -> tuple[str, float, bool]:
        schedule = self.schedule
        return schedule.phase_at(step).name, schedule.texel_factor(step), schedule.sharpened(step)

    def _typical(self, stage: tuple[str, float, bool]) -> float:
        """Mean seconds of a step, without pauses and the writing of checkpoints."""
        times = self._times[stage]
        longest = 5 * statistics.median(times)
        return statistics.mean(min(t, longest) for t in times)


def duration(seconds: float) -> str:
    """Seconds, minutes or hours in words."""
    for unit, size in (("hours", 3600), ("minutes", 60)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {unit}" if seconds < 10 * size else f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} seconds"
