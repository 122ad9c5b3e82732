"""How far a reconstruction can be believed, by evidence that a wrong track cannot fake.

A track that broke off and went on at another scale, or folded over, has a small reprojection error: each part fits its
own points. What it cannot do is to join them. So this looks at the verified matches of pairs of images, found without
any track: how many became points that both images see, how many lie on the epipolar lines of the two poses, and whether
that holds for the pairs across each gap between two frames. And points that are seen on both sides of a gap are found
twice, from either side alone: where the scale changes, the two differ. Two mappers that work in different ways are
compared with each other as well.

Pure functions of numpy arrays; ``collect.py`` reads them out of a model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.prepare.alignment import degrees_between, similarity_matrix

Array = NDArray[np.float64]
Places = NDArray[np.int64]

REACH = 12
"""Frames across a gap, at most, of the pairs that speak for it: farther ones have few matches and mostly wrong ones."""
FEW = 60
"""Matches across a gap below which it says nothing."""
LEAST_ANGLE = 1.0
"""Degrees between the first and the last ray on either side of a gap, from which a point is found from that side."""
LEAST_POINTS = 20
"""Such points from which a gap's scale is known."""
WINDOW = 5
"""Steps before and after a gap that are compared with each other."""


@dataclass(frozen=True)
class Pairs:
    """Verified matches of P pairs of registered images."""

    first: Places
    """Place of the first image in the order of the registered ones. [P]"""
    second: Places
    """Of the second, later one. [P]"""
    matches: Array
    """Verified matches. [P]"""
    tracked: Array
    """Of these, matches whose two keypoints see one point of the model. [P]"""
    fitting: Array
    """Of these, matches that lie on the epipolar lines of the two poses. [P]"""


@dataclass(frozen=True)
class Witness:
    """What one mapper says."""

    name: str
    """Of the mapper."""
    images: Sequence[str]
    """Names of the N registered images in their order."""
    places: Places
    """Their places among all images given. [N]"""
    poses: Array
    """Camera to world, OpenCV axes. [N, 4, 4]"""
    pairs: Pairs
    focal: float
    """Mean focal length over the longer side."""
    error: float
    """Mean reprojection error, pixels."""
    scales: Array
    """Logarithm of the change of scale across each gap, as far as it is certain; NaN where it is not known. [N - 1]"""


@dataclass(frozen=True)
class Agreement:
    """How far two tracks of the same cameras differ, after the best similarity."""

    images: Sequence[str]
    """Of both. [N]"""
    centers: Array
    """Distances of the centres, as shares of the extent of the track. [N]"""
    turns: Array
    """Degrees between the rotations. [N]"""


def share(part: Array, whole: Array) -> float:
    """Sum over sum; 0 of nothing."""
    return float(part.sum() / max(float(whole.sum()), 1.0))


def bridges(pairs: Pairs, count: int, part: Array) -> Array:
    """For each gap between two registered images, the share of the matches across it that hold.

    Args:
        pairs: of the model.
        count: registered images, N.
        part: ``pairs.tracked`` or ``pairs.fitting``. [P]

    Returns:
        Shares; NaN where too few matches lead across. [N - 1]
    """
    near = pairs.second - pairs.first <= REACH
    totals = np.zeros((2, count + 1))
    for row, values in enumerate((part, pairs.matches)):
        np.add.at(totals[row], pairs.first[near], values[near])
        np.add.at(totals[row], pairs.second[near], -values[near])
    held, crossing = np.cumsum(totals, axis=1)[:, : max(count - 1, 0)]
    return np.where(crossing >= FEW, held / np.maximum(crossing, 1), np.nan)


def held_by_image(pairs: Pairs, count: int) -> Array:
    """Share of each image's matches that became points; NaN where it has few. [N]"""
    held, matches = np.zeros(count), np.zeros(count)
    for ends in (pairs.first, pairs.second):
        np.add.at(held, ends, pairs.tracked)
        np.add.at(matches, ends, pairs.matches)
    return np.where(matches >= FEW, held / np.maximum(matches, 1), np.nan)


def scale_changes(points: Places, frames: Places, centers: Array, rays: Array, count: int) -> Array:
    """How the scale changes across each gap: the distance of points found from the frames after it alone, over that of
    the same points found from those before it.

    Bundle adjustment that got stuck, and a track that broke off and went on, leave such changes where reprojection
    errors and epipolar lines show little: a camera that sees a point twice as far off moves twice as fast.

    Args:
        points: number of the point that each observation sees. [O]
        frames: place of its image. [O]
        centers: of its camera. [O, 3]
        rays: unit, world axes. [O, 3]
        count: registered images, N.

    Returns:
        Medians over points of the logarithm, three standard errors nearer to 0; NaN where there are few. [N - 1]
    """
    order = np.lexsort((frames, points))
    points, frames, centers, rays = points[order], frames[order], centers[order], rays[order]
    first = np.searchsorted(points, points)
    stop = np.searchsorted(points, points, side="right")
    # Sums of what the least squares point of rays is made of, up to each observation: any range is a difference of two.
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    terms = np.concatenate([across, np.einsum("nij,nj->ni", across, centers)[..., None]], -1)
    sums = np.concatenate([np.zeros((1, 3, 4)), np.cumsum(terms, axis=0)])
    last = np.arange(len(points))  # before the gap
    last = last[(last > first) & (stop - last > 2)]
    wide = np.cos(np.radians(LEAST_ANGLE))
    before, after = (rays[first[last]], rays[last]), (rays[last + 1], rays[stop[last] - 1])
    last = last[((before[0] * before[1]).sum(-1) < wide) & ((after[0] * after[1]).sum(-1) < wide)]

    def distance(start: Places, end: Places) -> Array:
        found = sums[end] - sums[start]
        at = np.linalg.solve(found[:, :, :3], found[:, :, 3:])[..., 0]
        return ((at - centers[last]) * rays[last]).sum(-1)

    pair = distance(first[last], last + 1), distance(last + 1, stop[last])
    seen = (pair[0] > 0) & (pair[1] > 0)
    change, left, right = np.log(pair[1][seen] / pair[0][seen]), frames[last[seen]], frames[last[seen] + 1]
    result = np.full(max(count - 1, 0), np.nan)
    for gap in range(len(result)):
        own = change[(left <= gap) & (right > gap)]
        if len(own) >= LEAST_POINTS:
            middle = float(np.median(own))
            error = 1.48 * float(np.median(np.abs(own - middle))) / np.sqrt(len(own))
            result[gap] = np.sign(middle) * max(abs(middle) - 3 * error, 0.0)
    return result


def steps(witness: Witness) -> Array:
    """Distances from frame to frame, a missing frame's share taken off. [N - 1]"""
    return np.linalg.norm(np.diff(witness.poses[:, :3, 3], axis=0), axis=-1) / np.maximum(np.diff(witness.places), 1)


def jumps(witness: Witness) -> Array:
    """How many usual steps each step is long: of the median of the steps around it. [N - 1]"""
    lengths = steps(witness)
    floor = 0.05 * float(np.median(lengths)) if len(lengths) else 0.0
    return lengths / np.maximum(local_median(lengths, WINDOW) + floor, 1e-12)


def local_median(values: Array, reach: int) -> Array:
    """Median of the neighbours of each value, itself left out. [N] -> [N]"""
    rows = [np.delete(values[max(0, i - reach) : i + reach + 1], min(i, reach)) for i in range(len(values))]
    return np.array([np.median(row) if len(row) else values[i] for i, row in enumerate(rows)])


def speed_changes(witness: Witness) -> Array:
    """Ratio, at least 1, of the median steps after and before each frame; 1 near the ends, where there are few. [N]"""
    lengths = steps(witness)
    result = np.ones(len(witness.places))
    floor = 0.1 * float(np.median(lengths)) if len(lengths) else 0.0
    for i in range(WINDOW, len(lengths) - WINDOW + 1):
        before, after = (float(np.median(lengths[s])) + floor for s in (slice(i - WINDOW, i), slice(i, i + WINDOW)))
        result[i] = max(before, after) / max(min(before, after), 1e-12)
    return result


def agreement(one: Witness, other: Witness) -> Agreement | None:
    """How far two witnesses differ in the images that both have; None where these are fewer than three."""
    common = [n for n in one.images if n in set(other.images)]
    if len(common) < 3:
        return None
    a, b = (w.poses[[list(w.images).index(n) for n in common]] for w in (one, other))
    scale, rotation, translation = similarity_matrix(a, b)
    moved = scale * a[:, :3, 3] @ rotation.T + translation
    extent = max(float(np.linalg.norm(np.ptp(b[:, :3, 3], axis=0))), 1e-12)
    turns = degrees_between(rotation @ a[:, :3, :3], b[:, :3, :3])
    return Agreement(common, np.linalg.norm(moved - b[:, :3, 3], axis=-1) / extent, turns)
