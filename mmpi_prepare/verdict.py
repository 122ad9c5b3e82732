"""The verdict, right, doubtful or broken, with sentences that name frames and remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from mmpi_prepare.evidence import FEW, Witness, agreement, bridges, held_by_side, share, strides
from mmpi_prepare.images import in_short

Grade = Literal["right", "doubtful", "broken"]
ORDER: tuple[Grade, ...] = ("right", "doubtful", "broken")

TRACKED, BRIDGED, BRIDGED_OF_USUAL = (0.55, 0.3), (0.5, 0.25), (0.6, 0.35)
"""Share of the verified matches that must have become points, of all and of those across each gap between frames, and
the latter as a share of what others have. Like all pairs here: doubtful below the first, broken below the second."""
FITTING, FITTING_ACROSS = (0.9, 0.5), (0.83, 0.5)
"""Share of the matches on or close beside their epipolar lines that must lie on them, of all and across each gap: where
many are beside, the track is bent. (Matches far off are false, or belong to moving objects.)"""
HELD_ACROSS, HELD_BY_SIDE = (0.5, 0.25), (0.4, 0.15)
"""Share of all matches that must lie on their epipolar lines: of those across each gap, as false matches are fewer, and
of an image's matches with earlier, or with later, images."""
EDGE = 3
"""Number of images at either end of the track where a break is insignificant."""
SCALE = (0.03, 0.2)
"""Logarithm of a change of scale across a gap from which it is doubtful, and broken. (Sound tracks have 0.01.)"""
LOOSE = 0.25
"""Share of an image's matches that must have become points, or its pose is doubted."""
JUMP = 5.0
"""Step length, in usual steps, that counts as a jump: doubtful if few of the matches across it hold."""
CHANGE = 2.5
"""Ratio of speeds that counts as a sudden change; doubtful likewise."""
WEAK = 0.8
"""Share of the usual below which matches hold badly beside a jump."""
NEARLY_ALL = 0.9
"""Share of the images of the largest track below which another has clearly fewer."""
TURNS = (
    "A camera that turns in one place explains all matches, so that no distance is known: take images from places that "
    "are apart."
)


@dataclass(frozen=True)
class Verdict:
    """The verdict on a model."""

    grade: Grade
    summary: str = ""
    """Reasons in sentences, the most severe first; empty if it is right."""


def remedy(cameras: int, is_sequence: bool, is_given: bool) -> str:
    """Remedies for a capture of so many cameras, with or without given intrinsics."""
    ways = [] if is_sequence else ["add images that overlap more"]
    ways += ["give --focal, or --camera with its lens, if you know them"] if cameras == 1 and not is_given else []
    ways += ["try --lens radial, as each lens is known from few images"] if cameras > 1 and not is_given else []
    ways += ["mask what moves (--masks)"]
    ways += ["prepare the frames before and after apart"] if is_sequence else []
    text = "; or ".join(ways)
    return f"{text[0].upper()}{text[1:]}."


def worse(value: float, limits: tuple[float, float]) -> Grade:
    """The grade of a share that must not be below two limits."""
    return "right" if not value < limits[0] else "doubtful" if not value < limits[1] else "broken"


def judge_alone(witness: Witness, is_sequence: bool) -> Verdict:
    """The verdict on a mapper's model by its own evidence; a sequence has its images in the order of the motion."""
    pairs, count = witness.pairs, len(witness.images)
    tracked, fitting = share(pairs.tracked, pairs.matches), share(pairs.fitting, pairs.fitting + pairs.beside)
    problems: list[tuple[Grade, str]] = [
        (worse(tracked, TRACKED), f"Only {tracked:.0%} of the verified matches became points."),
        (worse(fitting, FITTING), f"{1 - fitting:.0%} of the verified matches miss the poses by a little."),
    ]
    if is_sequence:
        problems += _problems_along(witness)
    else:
        ends = np.concatenate([pairs.first, pairs.second])
        held, matches = (np.bincount(ends, np.tile(x, 2), count) for x in (pairs.tracked, pairs.matches))
        loose = [witness.images[int(i)] for i in np.flatnonzero((matches >= FEW) & (held < LOOSE * matches))]
        grade: Grade = "broken" if len(loose) > 0.1 * count else "doubtful" if loose else "right"
        problems.append((grade, f"Most matches of {in_short(loose)} contradict their poses."))
    severe = sorted((p for p in problems if p[0] != "right"), key=lambda p: -ORDER.index(p[0]))
    return Verdict(severe[0][0], " ".join(summary for _, summary in severe)) if severe else Verdict("right")


def _problems_along(witness: Witness) -> list[tuple[Grade, str]]:
    """Breaks, bends and jumps in the track of a sequence; none where few matches join its images."""
    pairs, count = witness.pairs, len(witness.images)
    across = bridges(pairs, count, pairs.tracked)
    if np.isnan(across).all():
        return []
    between = [f"between {one} and {next_one}" for one, next_one in pairwise(witness.images)]
    # The worst gap by the share of the matches across it that became points.
    usual, grades = float(np.nanmedian(across)), []
    for gap, held in enumerate(across):
        grade = max(worse(held, BRIDGED), worse(held / max(usual, 1e-9), BRIDGED_OF_USUAL), key=ORDER.index)
        at_an_end = min(gap + 1, len(across) - gap) < EDGE  # a few images may have few points and still be right
        grades.append("doubtful" if at_an_end and grade == "broken" else grade)
    at = max(range(len(across)), key=lambda gap: (ORDER.index(grades[gap]), -np.nan_to_num(across[gap], nan=1.0)))
    summary = f"{across[at]:.0%} of the matches across became points, {usual:.0%} elsewhere."
    problems: list[tuple[Grade, str]] = [(grades[at], f"The track breaks {between[at]}: {summary}")]
    # The worst gaps by matches beside, and far from, the epipolar lines of the poses, and the worst image.
    for word, limits, whole in (
        ("bent", FITTING_ACROSS, pairs.fitting + pairs.beside),
        ("broken", HELD_ACROSS, pairs.matches),
    ):
        fitting = bridges(pairs, count, pairs.fitting, whole)
        if np.isfinite(fitting).any():
            at = int(np.nanargmin(fitting))
            summary = f"{fitting[at]:.0%} of the matches across fit its poses."
            problems.append((worse(float(fitting[at]), limits), f"The track is {word} {between[at]}: {summary}"))
    held = held_by_side(pairs, count)
    if np.isfinite(held).any():
        side, at = divmod(int(np.nanargmin(held)), count)
        others, fitting = ("later" if side else "earlier"), float(held[side, at])
        summary = f"{witness.images[at]} is misplaced: {fitting:.0%} of its matches with {others} images fit its pose."
        problems.append((worse(fitting, HELD_BY_SIDE), summary))
    # The largest change of scale, and jumps and changes of speed where few matches hold across a gap.
    if np.isfinite(witness.scales).any():
        at = int(np.nanargmax(np.abs(witness.scales)))
        change = float(abs(witness.scales[at]))
        grade = "right" if change < SCALE[0] else "doubtful" if change < SCALE[1] else "broken"
        problems.append((grade, f"The scale changes by {np.expm1(change):.0%} {between[at]}."))
    is_weak = across < WEAK * usual
    jumps, changes = strides(witness)
    leaps = np.where(is_weak, jumps, 0.0)
    if leaps.max(initial=0.0) > JUMP:
        at = int(leaps.argmax())
        summary = f"{between[at]}, {leaps[at]:.0f} usual steps, and few matches across it hold."
        problems.append(("broken", f"The track jumps {summary}"))
    beside_weak = np.append(is_weak, False) | np.append(False, is_weak)
    changes = np.where(beside_weak, changes, 1.0)
    if changes.max(initial=1.0) > CHANGE:
        at = int(changes.argmax())
        summary = f"{changes[at]:.1f} times at {witness.images[at]}"
        problems.append(
            ("doubtful", f"The speed changes {summary}, where few matches hold: the scale may break there.")
        )
    return problems


def judge_together(
    chosen: Witness, others: Sequence[Witness], is_sequence: bool, before: Witness | None = None
) -> Verdict:
    """The verdict on the chosen model, given those of the other mapper and from other focal lengths; ``before`` is the
    chosen one before its own refinement, so that equals are compared.

    A different track makes it doubtful unless that one can be dismissed: by its own evidence, or because a third track
    agrees with the chosen one, which fits more matches. If two mappers found the same track independently, doubtful
    parts of it are accepted. Without parallax it is doubtful whoever agrees.
    """
    alone = judge_alone(chosen, is_sequence)
    if chosen.only_turns and alone.grade != "broken":
        return Verdict("doubtful", f"{TURNS} {alone.summary}".strip())
    compared = []
    for other in others:
        differences = [d for w in (before or chosen, chosen) if (d := agreement(w, other)) is not None]
        if differences:
            compared.append((other, next((d for d in differences if d.is_same), differences[0])))
    is_confirmed = any(d.is_same and other.name != chosen.name for other, d in compared)
    against = [
        (other, d)
        for other, d in compared
        if not d.is_same
        and (
            (judge_alone(other, is_sequence).grade == "right" and not (is_confirmed and _fit(other) < _fit(chosen)))
            or (alone.grade != "right" and not is_confirmed)
        )
    ]
    if alone.grade == "broken" or not against:
        return alone if alone.grade == "broken" or not is_confirmed else Verdict("right")
    other, difference = against[0]
    worst = [difference.images[int(i)] for i in np.argsort(-difference.centers)[:3]]
    summary = (
        f"The {chosen.name} and the {other.name} mapper differ by {difference.centers.mean():.1%} of the track "
        f"({difference.centers.max():.1%} at most; most at {', '.join(worst)}) and by {difference.turns.mean():.1f} "
        f"degrees ({difference.turns.max():.1f} at most), with focal lengths of {chosen.focal:.2f} and "
        f"{other.focal:.2f} image sides."
    )
    return Verdict("doubtful", f"{alone.summary} {summary}".strip())


def _fit(witness: Witness) -> float:
    """Share of the matches that fit the poses, to a hundredth."""
    return round(share(witness.pairs.fitting, witness.pairs.matches), 2)


def best_first(witnesses: Sequence[Witness], is_sequence: bool) -> list[Witness]:
    """The witnesses, the most credible first.

    Broken ones are last, and those with clearly fewer images than another come after it: a small part of the capture
    is seldom wrong. Then by verdict, by images, by the share of the matches that fit the poses, to a hundredth, and by
    matches that became points. (A bent track may have more points than a right one: its points fit its bends.)
    """
    grades, sizes = [judge_alone(w, is_sequence).grade for w in witnesses], [len(w.images) for w in witnesses]
    most = max((size for grade, size in zip(grades, sizes, strict=True) if grade != "broken"), default=0)
    credits = [
        (g != "broken", n >= NEARLY_ALL * most, -ORDER.index(g), n, _fit(w), float(w.pairs.tracked.sum()))
        for g, n, w in zip(grades, sizes, witnesses, strict=True)
    ]
    return [witnesses[i] for i in sorted(range(len(credits)), key=credits.__getitem__, reverse=True)]
