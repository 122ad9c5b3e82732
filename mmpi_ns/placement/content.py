"""What placement weighs: which camera sees what, how far away, robust to outliers, and independent of any order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.placement.observations import Array, Observations, frustum_points

SAMPLED, SAMPLED_PER_CAMERA = 6000, 16
"""Observations that the choice is based on: so many, or so many a camera where that is more."""
FAR_SHARE = 0.15
"""Weight of what lies far away in every image, where there may be no keypoints (sky) but must be a plane."""
WINDOW, SUPPORT = 1.5, 0.04
"""Content starts where so many of a camera's observations lie within a factor of WINDOW in depth."""


@dataclass(frozen=True)
class Content:
    """Where the content of a scene lies, as placement sees it."""

    cameras: NDArray[np.int64]
    """[Q] camera of each observation."""
    points: Array
    """[Q, 3] what it observes."""
    weights: Array
    """[Q] what an observation counts; they sum to the number of cameras."""
    nearest: Array
    """[M] depth, along each camera's axis, at which its content starts."""
    near: float
    """Distance at which content starts for the cameras in general."""


def find_content(observations: Observations) -> Content:
    """The observations that placement weighs: keypoints, else points filling the cameras' frusta, and the far distance.

    Observations that are not finite or lie behind their camera are left out. Without any points the nearest content is
    taken to lie at a tenth of the cameras' spread.

    Raises:
        ValueError: nothing is left.
    """
    centers = observations.centers
    if len(observations.seen_by):
        cameras, points = observations.seen_by, observations.points[observations.seen_point]
    else:
        spread = float(np.linalg.norm(centers - centers.mean(0), axis=-1).max())
        points = frustum_points(observations, near=max(0.1 * spread, 1e-3))
        cameras = np.repeat(np.arange(len(centers)), len(points) // len(centers))
    good = np.isfinite(points).all(-1)
    cameras, points = cameras[good], points[good]
    depth = _depth(observations, cameras, points)
    cameras, points, depth = cameras[depth > 0], points[depth > 0], depth[depth > 0]
    if not len(points):
        raise ValueError("No point lies in front of the camera that saw it: check the poses and the points' frame.")
    starts = {i: _start(depth[cameras == i]) for i in range(len(centers)) if (cameras == i).sum() >= 20}
    near = float(np.median(list(starts.values()))) if starts else _start(depth)
    nearest = np.array([starts.get(i, near) for i in range(len(centers))])
    return _weighed(observations, cameras, points, nearest, near)


def _depth(observations: Observations, cameras: NDArray[np.int64], points: Array) -> Array:
    poses = observations.camera_to_worlds[cameras]
    return -np.einsum("qi,qi->q", points - poses[:, :, 3], poses[:, :, 2])


def _start(depth: Array) -> float:
    """The least depth from which on a factor of WINDOW holds SUPPORT of all: a lone outlier in front does not count."""
    ordered = np.sort(depth)
    inside = np.searchsorted(ordered, ordered * WINDOW, side="right") - np.arange(len(ordered))
    return float(ordered[np.argmax(inside >= max(1.0, SUPPORT * len(ordered)))])


def _weighed(
    observations: Observations, cameras: NDArray[np.int64], points: Array, nearest: Array, near: float
) -> Content:
    count = len(observations.centers)
    # Evenly spaced in an order that no numbering, pose or unit enters: by depth.
    order = np.argsort(_depth(observations, cameras, points) / near, kind="stable")
    wanted = min(len(order), max(SAMPLED, SAMPLED_PER_CAMERA * count))
    keep = order[np.linspace(0, len(order) - 1, wanted).round().astype(int)]
    far_cameras, far_points = _far(observations, 1e4 * near)
    weights = [
        np.full(len(keep), (1 - FAR_SHARE) * count / len(keep)),
        np.full(len(far_points), FAR_SHARE * count / len(far_points)),
    ]
    return Content(
        np.concatenate([cameras[keep], far_cameras]),
        np.concatenate([points[keep], far_points]),
        np.concatenate(weights),
        nearest,
        near,
    )


def _far(observations: Observations, distance: float) -> tuple[NDArray[np.int64], Array]:
    """Six points far away in every image, near its corners and the middles of its long sides."""
    shares = np.array([[x, y] for x in (0.05, 0.5, 0.95) for y in (0.1, 0.9)])
    cameras = np.repeat(np.arange(len(observations.centers)), len(shares))
    fx, fy, cx, cy = observations.intrinsics[cameras].T
    pixels = np.tile(shares, (len(observations.centers), 1)) * observations.sizes[cameras]
    local = np.stack([(pixels[:, 0] - cx) / fx, -(pixels[:, 1] - cy) / fy, -np.ones(len(cameras))], -1)
    world = np.einsum("qij,qj->qi", observations.camera_to_worlds[cameras][:, :, :3], local)
    return cameras, observations.centers[cameras] + distance * world
