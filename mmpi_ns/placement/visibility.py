"""Visibility: which camera sees which points and how far away; robust to outliers, and independent of any order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.placement.observations import FILLING, Array, Observations, frustum_points
from mmpi_ns.utils.errors import InputError

SAMPLED, SAMPLED_PER_CAMERA = 6000, 16
"""Minimum number of observations that the choice is based on, in all and for each camera, if there are as many."""
FRUSTUM_SHARE, FEW = 0.15, 10
"""Weight, in every image, of points that fill its frustum: a share, and most of it with FEW keypoints or less. An
image without keypoints (sky, a white wall) needs planes too."""
SPAN = (0.25, 0.9)
"""Quantiles of depth between which the points of an image are said to lie."""
COVERED, LEAST_COVERED = 3000, 0.25
"""Points whose images are counted, and the share of them that fewer pixels than stated may see."""
WINDOW, SUPPORT = 1.5, 0.04
"""Content starts, for a camera, at the least depth from which a factor of WINDOW holds the share SUPPORT of its
observations."""


@dataclass(frozen=True)
class VisiblePoints:
    """The points that placement weighs, and the cameras that see them."""

    cameras: NDArray[np.int64]
    """[Q] camera of each observation."""
    points: Array
    """[Q, 3] what it observes."""
    weights: Array
    """[Q] what an observation counts; those of a camera sum to 1."""
    nearest: Array
    """[M] depth, along each camera's axis, at which its points start."""
    typical: Array
    """[M, 2] depths before which a quarter and nine tenths of each camera's points lie."""
    near: float
    """Depth at which points start for the cameras in general."""


def find_visible_points(observations: Observations) -> VisiblePoints:
    """The observations that placement weighs: keypoints, and points that fill the cameras' frusta.

    Keypoints that are not finite or lie behind their camera are left out. Without any the nearest point is taken to lie
    at a tenth of the cameras' spread.

    Raises:
        InputError: there are keypoints, and none of them can be used.
    """
    centers = observations.centers
    cameras, points = observations.seen_by, observations.points[observations.seen_point]
    good = np.isfinite(points).all(-1)
    cameras, points = cameras[good], points[good]
    depth = observations.depths(cameras, points)
    cameras, points, depth = cameras[depth > 0], points[depth > 0], depth[depth > 0]
    if not len(points):
        if len(observations.seen_by):
            raise InputError("No point lies in front of the camera that saw it: check the poses and the points' frame.")
        spread = float(np.linalg.norm(centers - centers.mean(0), axis=-1).max())
        depth = np.array([max(0.1 * spread, 1e-3)])
    starts = {i: _start(depth[cameras == i]) for i in range(len(centers)) if (cameras == i).sum() >= 20}
    near = float(np.median(list(starts.values()))) if starts else _start(depth)
    nearest = np.array([starts.get(i, near) for i in range(len(centers))])
    typical = np.tile(np.quantile(depth, SPAN), (len(centers), 1))
    for i in starts:
        typical[i] = np.quantile(depth[cameras == i], SPAN)
    # Evenly spaced in an order that no numbering, pose or unit enters: by depth.
    order = np.argsort(observations.depths(cameras, points) / near, kind="stable")
    sampled = min(len(order), max(SAMPLED, SAMPLED_PER_CAMERA * len(centers)))
    keep = order[np.linspace(0, len(order) - 1, sampled).round().astype(int)]
    cameras, points = cameras[keep], points[keep]
    seen = np.bincount(cameras, minlength=len(centers))
    share = (1 - FRUSTUM_SHARE) * seen / (seen + FEW)
    filling = frustum_points(observations, nearest)
    return VisiblePoints(
        cameras=np.concatenate([cameras, np.repeat(np.arange(len(centers)), FILLING)]),
        points=np.concatenate([points, filling]),
        weights=np.concatenate([(share / np.maximum(seen, 1))[cameras], np.repeat((1 - share) / FILLING, FILLING)]),
        nearest=nearest,
        typical=typical,
        near=near,
    )


def pixels_per_pixel(observations: Observations, visible: VisiblePoints) -> float:
    """Training pixels that fall, in all images together, on what one pixel of an image shows; at least 1.

    An image counts by the square of its magnification relative to the observing one. Three quarters of what the
    cameras see are covered by at least this many pixels. Occlusion is not considered.
    """
    some = np.linspace(0, len(visible.cameras) - 1, min(COVERED, len(visible.cameras))).round().astype(int)
    cameras, points, weights = visible.cameras[some], visible.points[some], visible.weights[some]
    magnification = observations.intrinsics[cameras, 0] / observations.depths(cameras, points)
    covered = np.zeros(len(some))
    for i in range(len(observations.centers)):
        camera = np.full(len(some), i)
        depths = observations.depths(camera, points)
        pixels, ahead = observations.project(camera, points)
        seen = (depths > 0) & (
            observations.wide[i] | (ahead & ((pixels >= 0) & (pixels <= observations.sizes[i])).all(-1))
        )
        covered[seen] += (observations.intrinsics[i, 0] / depths[seen] / magnification[seen]) ** 2
    order = np.argsort(covered, kind="stable")
    share = np.cumsum(weights[order])
    return max(1.0, float(covered[order[np.searchsorted(share, LEAST_COVERED * share[-1])]]))


def farthest_first(places: Array, count: int | None = None, radius: float = 0.0) -> list[int]:
    """Places far apart, each the farthest from the previous ones (farthest-point traversal, Gonzalez 1985).

    Starts at the place farthest from the middle, so the numbering does not matter.

    Args:
        places: [M, D]
        count: number of places; None: as many as it takes until balls of ``radius`` around them contain all.
        radius: of the balls.
    """
    chosen = [int(np.linalg.norm(places - places.mean(0), axis=-1).argmax())]
    distance = np.linalg.norm(places - places[chosen[0]], axis=-1)
    while distance.max() > radius if count is None else len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=-1))
    return chosen


def _start(depth: Array) -> float:
    """The least depth from which on a factor of WINDOW holds SUPPORT of all: a lone outlier in front does not count."""
    ordered = np.sort(depth)
    inside = np.searchsorted(ordered, ordered * WINDOW, side="right") - np.arange(len(ordered))
    return float(ordered[np.argmax(inside >= max(1.0, SUPPORT * len(ordered)))])
