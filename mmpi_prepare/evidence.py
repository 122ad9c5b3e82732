"""Evidence on the correctness of a reconstruction that a wrong track cannot satisfy.

A track that breaks and continues at another scale, or folds over, has a small reprojection error: each part fits its
own points, but matches between the parts do not fit. So the evidence is taken from the verified matches of image
pairs, which do not depend on any track: how many became points that both images see, and how many lie on the epipolar
lines of the two poses, also separately for the pairs across each gap between two frames. In addition, points seen on
both sides of a gap are triangulated twice, from either side alone: if the scale changes, the two differ. The results of
two different mappers are compared as well.

All but ``witness_of``, which reads a model and its database, are pure functions of numpy arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mmpi_prepare.adjustment import Array, camera_poses, degrees_between, nearest_rotation, similarity_between
from mmpi_priors.sfm import MIN_INLIERS, epipolar_distances, verified_matches

Places = NDArray[np.int64]

FIT_PX, BESIDE = 2.0, 4.0
"""Sampson distance, in pixels of an image side of 1,000, up to which a match lies on its epipolar line, and the
multiple of it up to which it lies beside it."""
REACH = 12
"""Maximum frame distance of pairs used for a gap; pairs farther apart have few matches, most of them wrong."""
FEW, FEW_OF_ONE = 60, 40
"""Minimum number of matches for a statement about a gap, and of an image's with earlier or later ones about it."""
LEAST_ANGLE, LEAST_POINTS = 1.0, 20
"""Minimum angle in degrees between the first and last ray on one side of a gap for triangulation from that side, and
minimum number of such points for the scale of a gap."""
WINDOW = 5
"""Steps before and after a gap that are compared with each other."""
ZOOMS, FINE_ZOOMS = np.geomspace(0.4, 2.5, 19), np.geomspace(0.91, 1.1, 13)
"""Focal lengths, over that of the model, with which a camera is tried that only turns; and over the best of them."""
TURNING, TURNING_PAIRS, TRIED = 0.9, 0.95, 200
"""Share of a pair's matches, and of the pairs, that such a camera must explain; number of pairs that are tried."""
APART, TURNED = (0.01, 0.03), (1.0, 2.0)
"""Mean and largest distance between the centres of two mappers, as shares of the track, up to which they found the same
one, and the same of their rotations, in degrees."""


@dataclass(frozen=True)
class Pairs:
    """Verified matches of P pairs of registered images."""

    first: Places
    """Index of the first image among the registered ones. [P]"""
    second: Places
    """Of the second, later one. [P]"""
    matches: Array
    """Verified matches. [P]"""
    tracked: Array
    """Of these, matches whose two keypoints see one point of the model. [P]"""
    fitting: Array
    """Of these, matches that lie on the epipolar lines of the two poses. [P]"""
    beside: Array
    """Of these, matches that lie close beside them: a bent track has many. Matches far off are false, or the poses are
    broken. [P]"""


@dataclass(frozen=True)
class Witness:
    """The model of one mapper, and the evidence on it."""

    name: str
    """Of the mapper."""
    images: Sequence[str]
    """Names of the N registered images in order."""
    places: Places
    """Their indices among all images given. [N]"""
    poses: Array
    """Camera to world, OpenCV axes. [N, 4, 4]"""
    pairs: Pairs
    focal: float
    """Mean focal length over the longer side."""
    scales: Array
    """Logarithm of the change of scale across each gap, reduced to its certain part; NaN if unknown. [N - 1]"""
    summary: str
    """How the mapper made it, in words."""
    model: pycolmap.Reconstruction
    only_turns: bool = False
    """Whether a camera that turns in one place would explain the matches as well: then the poses are arbitrary."""


@dataclass(frozen=True)
class Agreement:
    """Difference between two tracks of the same cameras after similarity alignment."""

    images: Sequence[str]
    """Of both. [N]"""
    centers: Array
    """Distances of the centres, relative to the extent of the track. [N]"""
    turns: Array
    """Degrees between the rotations. [N]"""
    is_same: bool
    """Whether both are the same track."""


def witness_of(
    name: str, summary: str, model: pycolmap.Reconstruction, database: Path, offered: Sequence[str]
) -> Witness:
    """The evidence on a mapper's model, which has the keypoints of the database; ``offered`` are the names of all
    images of the capture in order. Images of one frame of a rig count as the first of them.

    A lens has no ray for a pixel beyond its largest image radius (COLMAP returns NaN): matches there fit nothing.
    """
    names, poses = camera_poses(model)
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    frames = list(dict.fromkeys(image.frame_id for image in images))
    place = {image.image_id: frames.index(image.frame_id) for image in images}
    points = {  # the point that each keypoint sees, -1 for none
        image.image_id: np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], dtype=np.int64)
        for image in images
    }
    rays, observations = {}, []  # rays in the camera, with z = 1
    for image, pose in zip(images, poses, strict=True):
        pixels = np.array([p.xy for p in image.points2D], dtype=np.float64).reshape(-1, 2)
        rays[image.image_id] = np.asarray(model.cameras[image.camera_id].cam_from_img(pixels)).reshape(-1, 2)
        seen = points[image.image_id]
        certain = (seen >= 0) & np.isfinite(rays[image.image_id]).all(-1)
        directions = np.c_[rays[image.image_id], np.ones(len(seen))][certain] @ pose[:3, :3].T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        center = np.tile(pose[:3, 3], (len(directions), 1))
        observations.append((seen[certain], np.full(len(directions), place[image.image_id]), center, directions))
    points_seen, places, centers, directions = (np.concatenate(column) for column in zip(*observations, strict=True))
    rows, matched, fits = [], [], []  # of pairs of registered images
    for a, b, matches in verified_matches(database):
        if a not in place or b not in place or len(matches) < MIN_INLIERS:
            continue
        left, right = matches.T
        tracked = (points[a][left] == points[b][right]) & (points[a][left] >= 0)
        camera = model.cameras[model.images[a].camera_id]
        fit = FIT_PX * max(camera.width, camera.height) / 1000 / camera.mean_focal_length()
        finite = np.isfinite(np.c_[rays[a][left], rays[b][right]]).all(-1)  # the others fit nothing
        matched_rays = rays[a][left][finite], rays[b][right][finite]
        distance = epipolar_distances(model, a, b, matched_rays) / fit
        fitting, beside = int((distance < 1).sum()), int(((distance >= 1) & (distance < BESIDE)).sum())
        rows.append((place[a], place[b], len(left), int(tracked.sum()), fitting, beside))
        matched.append(matched_rays)
        fits.append(fit)
    table = np.array(rows, dtype=np.int64).reshape(-1, 6)
    low, high = table[:, :2].min(1, initial=len(frames)), table[:, :2].max(1, initial=0)
    names, poses = names[: len(frames)], poses[: len(frames)]  # those of the first sensor come first
    camera, order = model.cameras[images[0].camera_id], {image: i for i, image in enumerate(offered)}
    return Witness(
        name,
        names,
        np.array([order[n] for n in names], dtype=np.int64),
        poses,
        Pairs(low, high, *table[:, 2:].T.astype(np.float64)),
        camera.mean_focal_length() / max(camera.width, camera.height),
        scale_changes(points_seen, places, centers, directions, len(names)),
        summary,
        model,
        turns_explain(matched, fits),
    )


def turns_explain(matched: Sequence[tuple[Array, Array]], fits: Sequence[float]) -> bool:
    """Whether a camera that only turns explains the matches of nearly all pairs, with one focal length or another.

    Args:
        matched: matched keypoints of each pair, in the plane z = 1 of either camera. [M, 2] each
        fits: distance there up to which a match of the pair is explained.

    Matches that are not finite are left out, and pairs of fewer than ``MIN_INLIERS`` others.
    """
    sound = []
    for (first, second), fit in zip(matched, fits, strict=True):
        finite = np.isfinite(np.c_[first, second]).all(-1)
        if finite.sum() >= MIN_INLIERS:
            sound.append(((first[finite], second[finite]), fit))
    tried = sound[:: max(1, len(sound) // TRIED)]
    if not tried:
        return False

    def errors(zoom: float) -> Array:
        """Of each pair, the distance within which a rotation takes the share ``TURNING`` of keypoints to their matches,
        over that up to which one is explained."""
        within = []
        for (first, second), fit in tried:
            a, b = (np.c_[xy / zoom, np.ones(len(xy))] for xy in (first, second))
            a, b = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (a, b))
            best, error = np.ones(len(a), bool), np.zeros(len(a))
            for _ in range(3):  # the rotation of those that fit it best
                turned = a @ nearest_rotation(b[best].T @ a[best]).T
                error = np.linalg.norm(turned[:, :2] / turned[:, 2:] - second / zoom, axis=-1)
                best = error <= np.quantile(error, 0.8)
            within.append(np.quantile(error, TURNING) / (fit / zoom))
        return np.array(within)

    coarse = min(ZOOMS, key=lambda zoom: float(np.median(errors(zoom))))
    fine = min(coarse * FINE_ZOOMS, key=lambda zoom: float(np.median(errors(zoom))))
    return bool(np.mean(errors(fine) < 1) >= TURNING_PAIRS)


def share(part: Array, whole: Array) -> float:
    """Ratio of two sums; 0 if the second is 0."""
    return float(part.sum() / max(float(whole.sum()), 1.0))


def bridges(pairs: Pairs, count: int, part: Array, whole: Array | None = None) -> Array:
    """Fraction of the matches across each gap between two of N registered images that hold, NaN for few. [N - 1]

    Args:
        pairs, count: of the model; N.
        part: ``pairs.tracked`` or ``pairs.fitting``. [P]
        whole: what it is a part of; all matches unless given. [P]
    """
    near = pairs.second - pairs.first <= REACH
    first, second = pairs.first[near], pairs.second[near]
    held, crossing = (
        np.cumsum(np.bincount(first, x[near], count) - np.bincount(second, x[near], count))[:-1]
        for x in (part, pairs.matches if whole is None else whole)
    )
    return np.where(crossing >= FEW, held / np.maximum(crossing, 1), np.nan)


def held_by_side(pairs: Pairs, count: int) -> Array:
    """Share of each image's matches with earlier images, and with later ones, that fit the poses; NaN for few. [2, N]

    An image that is misplaced, alone or at a break, contradicts all images of one side, while most matches across the
    gaps beside it, which join other images, may hold.
    """
    held, matches = (
        np.stack([np.bincount(ends, x, count) for ends in (pairs.second, pairs.first)])
        for x in (pairs.fitting, pairs.matches)
    )
    return np.where(matches >= FEW_OF_ONE, held / np.maximum(matches, 1), np.nan)


def scale_changes(points: Places, frames: Places, centers: Array, rays: Array, count: int) -> Array:
    """Change of scale across each gap: the distance of points triangulated from the frames after it alone, over that of
    the same points from those before it.

    A bundle adjustment that got stuck, or a track that broke, leaves such changes even if reprojection errors and
    epipolar lines show little.

    ``points`` and ``frames`` [O] are the point that each observation sees, and the place of its image; ``centers`` and
    unit ``rays`` [O, 3] of its camera are in world axes. Returns medians over points of the logarithm, moved three
    standard errors towards 0, for N = ``count`` registered images; NaN if there are few. [N - 1]
    """
    order = np.lexsort((frames, points))
    points, frames, centers, rays = points[order], frames[order], centers[order], rays[order]
    first = np.searchsorted(points, points)
    stop = np.searchsorted(points, points, side="right")
    # Prefix sums of the normal equations of the point nearest to rays: any range is a difference of two.
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    terms = np.concatenate([across, np.einsum("nij,nj->ni", across, centers)[..., None]], -1)
    sums = np.concatenate([np.zeros((1, 3, 4)), np.cumsum(terms, axis=0)])
    last = np.arange(len(points))  # before the gap
    last = last[(last > first) & (stop - last > 2)]
    wide = np.cos(np.radians(LEAST_ANGLE))
    before, after = (rays[first[last]], rays[last]), (rays[last + 1], rays[stop[last] - 1])
    last = last[((before[0] * before[1]).sum(-1) < wide) & ((after[0] * after[1]).sum(-1) < wide)]
    distances = []  # of the points from the last frame before the gap, by the frames before it and by those after it
    for start, end in ((first[last], last + 1), (last + 1, stop[last])):
        terms = sums[end] - sums[start]
        at = np.linalg.solve(terms[:, :, :3], terms[:, :, 3:])[..., 0]
        distances.append(((at - centers[last]) * rays[last]).sum(-1))
    near, far = distances
    seen = (near > 0) & (far > 0)
    change, left, right = np.log(far[seen] / near[seen]), frames[last[seen]], frames[last[seen] + 1]
    result = np.full(max(count - 1, 0), np.nan)
    for gap in range(len(result)):
        across_gap = change[(left <= gap) & (right > gap)]
        if len(across_gap) >= LEAST_POINTS:
            middle = float(np.median(across_gap))
            error = 1.48 * float(np.median(np.abs(across_gap - middle))) / np.sqrt(len(across_gap))
            result[gap] = np.sign(middle) * max(abs(middle) - 3 * error, 0.0)
    return result


def local_median(values: Array, reach: int) -> Array:
    """Median of the neighbours of each value, excluding itself. [N] -> [N]"""
    rows = [np.delete(values[max(0, i - reach) : i + reach + 1], min(i, reach)) for i in range(len(values))]
    return np.array([np.median(row) if len(row) else values[i] for i, row in enumerate(rows)])


def strides(witness: Witness) -> tuple[Array, Array]:
    """Length of each step, divided among missing frames, relative to the median of the steps around it [N - 1]; ratio,
    at least 1, of the median steps after and before each frame, 1 near the ends, where there are few [N]."""
    lengths = np.linalg.norm(np.diff(witness.poses[:, :3, 3], axis=0), axis=-1) / np.maximum(np.diff(witness.places), 1)
    usual = float(np.median(lengths)) if len(lengths) else 0.0
    jumps = lengths / np.maximum(local_median(lengths, WINDOW) + 0.05 * usual, 1e-12)
    changes = np.ones(len(witness.places))
    for i in range(WINDOW, len(lengths) - WINDOW + 1):
        before, after = (float(np.median(lengths[s : s + WINDOW])) + 0.1 * usual for s in (i - WINDOW, i))
        changes[i] = max(before, after) / max(min(before, after), 1e-12)
    return jumps, changes


def agreement(first: Witness, second: Witness) -> Agreement | None:
    """Difference of two witnesses in the images that both have; None if there are fewer than three.

    Centres and rotations are aligned each for itself: another principal point turns all cameras alike.
    """
    common = [n for n in first.images if n in set(second.images)]
    if len(common) < 3:
        return None
    a, b = (w.poses[[list(w.images).index(n) for n in common]] for w in (first, second))
    similarity = similarity_between(a, b).matrix()
    moved = a[:, :3, 3] @ similarity[:, :3].T + similarity[:, 3]
    extent = max(float(np.linalg.norm(np.ptp(b[:, :3, 3], axis=0))), 1e-12)
    a_turns, b_turns = a[:, :3, :3], b[:, :3, :3]
    turns = degrees_between(nearest_rotation(np.einsum("nij,nkj->ik", b_turns, a_turns)) @ a_turns, b_turns)
    centers = np.linalg.norm(moved - b[:, :3, 3], axis=-1) / extent
    limits = ((centers, APART), (turns, TURNED))
    is_same = all(values.mean() <= mean and values.max() <= largest for values, (mean, largest) in limits)
    return Agreement(common, centers, turns, is_same)
