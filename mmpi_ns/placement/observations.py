"""Input of placement: training cameras, SfM points and their keypoints, and the weighted observations made from them:
robust to outliers and independent of any order. Plain float64 NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.utils.errors import InputError

Array = NDArray[np.float64]

WIDE = 1.5
"""Tangent beyond which a lens that compresses its borders counts as wide: planes facing like the camera cover too
little of its field of view."""
SQUEEZED = 1.3
"""Factor in tangents by which such a lens sees farther than a pinhole of its focal length."""
BEYOND_LENS = 0.05
"""Margin, as a cosine, by which a keypoint may lie beyond the borders of its lens."""
FILLING = 24
"""Number of points that fill the frustum of a camera."""
SAMPLED, SAMPLED_PER_CAMERA = 6000, 16
"""Minimum number of observations that the choice is based on, in all and for each camera, if there are as many."""
FRUSTUM_SHARE, FEW = 0.15, 10
"""Weight, in every image, of points that fill its frustum: a share, and most of it with FEW keypoints or less. An
image without keypoints (sky, a white wall) needs planes too."""
SPAN = (0.25, 0.9)
"""Quantiles that bound the depths of an image's points."""
COVERED, LEAST_COVERED = 3000, 0.25
"""Number of points for which images are counted, and share of them that may be seen by fewer pixels than the result."""
APART = 1e-9
"""Cameras closer together than this fraction of the largest distance (at least 1) stand in one place: no parallax."""
ALONG = 0.9
"""Cosine of the angle between path and line of sight beyond which a camera looks along its path; a walk through rooms
has a median of 0.7, a drive 0.99."""
FACTOR, SUPPORT = 1.5, 0.04
"""Content starts, for a camera, at the least depth such that depths up to FACTOR times it contain the share SUPPORT of
its observations."""


@dataclass(frozen=True)
class Observations:
    """Training cameras and, if there is structure from motion, points and their keypoints."""

    camera_to_worlds: Array
    """[M, 3, 4], OpenGL axes (x right, y up, z backwards), scene units."""
    intrinsics: Array
    """[M, 4]: fx, fy, cx, cy in pixels."""
    sizes: Array
    """[M, 2]: width, height in pixels."""
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """[P, 3] SfM points in scene units; P may be 0."""
    seen_by: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """[Q] camera of each keypoint; Q may be 0."""
    seen_point: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """[Q] point of each keypoint."""
    seen_at: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """[S, 2] pixel (x, y) of the first S <= Q keypoints, those of SfM; the others come from estimated surfaces."""
    lens: Array | None = None
    """[M, G, G, 3] unit directions, in camera axes, through a grid over each image from border to border, row after
    row; None if all cameras are pinholes."""
    loose: Array | None = None
    """[L, 3] points of a cloud without visibility (``mmpi_priors/clouds.py`` determines it)."""

    @property
    def centers(self) -> Array:
        return self.camera_to_worlds[:, :, 3]

    @property
    def focal(self) -> float:
        """Median focal length in pixels."""
        return float(np.median(self.intrinsics[:, :2]))

    @property
    def looks_along_path(self) -> bool:
        """Whether most cameras look towards or away from the nearest other one: what lies just beyond the borders of an
        image is then in an earlier or later one."""
        poses, cosines = self.camera_to_worlds, []
        for i, pose in enumerate(poses):
            for j in nearest_views(poses, i, count=1):
                step = poses[j, :, 3] - pose[:, 3]
                cosines.append(abs(step @ pose[:, 2]) / np.linalg.norm(step))
        return bool(cosines) and float(np.median(cosines)) > ALONG

    @property
    def tracked(self) -> tuple[NDArray[np.int64], Array]:
        """Camera [S] and point [S, 3] of each keypoint of SfM; those of estimated surfaces are too inaccurate for
        depths."""
        count = len(self.seen_at)
        return self.seen_by[:count], self.points[self.seen_point[:count]]

    def with_keypoints(self, keep: NDArray[np.bool_]) -> Observations:
        """The observations with these keypoints [Q] alone. Points keep their numbers."""
        seen_at = self.seen_at[keep[: len(self.seen_at)]]
        return replace(self, seen_by=self.seen_by[keep], seen_point=self.seen_point[keep], seen_at=seen_at)

    @property
    def mean_axes(self) -> Array:
        """Rows x (right), y (down), z (facing) of the mean camera; gravity is the cameras' mean up vector.

        Only sums of camera axes are used, so a rotated scene gives the rotated frame. If the cameras look in all
        directions, the mean is ill-defined, and the horizontal direction of the first camera is used instead.
        """
        up = self.camera_to_worlds[:, :, 1].mean(0)
        up = up / max(float(np.linalg.norm(up)), 1e-12)
        mean_facing = -self.camera_to_worlds[:, :, 2].mean(0)
        facing = mean_facing if np.linalg.norm(mean_facing) > 0.3 else -self.camera_to_worlds[0, :, 2]
        right = np.cross(facing, up)
        if np.linalg.norm(right) < 1e-3:  # looking straight up or down: any horizontal axis will do
            right = self.camera_to_worlds[0, :, 0]
        right = right - right.dot(up) * up
        right = right / max(float(np.linalg.norm(right)), 1e-12)
        return np.stack([right, -up, np.cross(right, -up)])

    @cached_property
    def wide(self) -> NDArray[np.bool_]:
        """[M] mask of the cameras that see farther to the sides than planes in front of them can cover."""
        if self.lens is None:
            return np.zeros(len(self.centers), dtype=bool)
        ahead = -self.lens[..., 2]
        aside = np.abs(self.lens[..., :2]).max(-1)
        tangent = np.where(ahead > 1e-3, aside / np.maximum(ahead, 1e-3), np.inf).max((1, 2))
        middle, focal = self.intrinsics[:, 2:], self.intrinsics[:, :2]
        pinhole = (np.maximum(middle, self.sizes - middle) / focal).max(-1)
        return (tangent > WIDE) & (tangent > SQUEEZED * pinhole)

    def depths(self, cameras: NDArray[np.int64], points: Array) -> Array:
        """Depths [Q] of points [Q, 3] along the axes of cameras [Q]; negative behind.

        Those of wide cameras are along the nearest of the camera's axes, sideways too; negative beyond the lens.
        """
        poses = self.camera_to_worlds[cameras]
        depths = -np.einsum("qi,qi->q", points - poses[:, :, 3], poses[:, :, 2])
        wide = self.wide[cameras]
        if self.lens is not None and wide.any():
            local = np.einsum("qji,qj->qi", poses[wide, :, :3], points[wide] - poses[wide, :, 3])
            least = -self.lens[..., 2].max((1, 2))[cameras[wide]] - BEYOND_LENS
            length = np.linalg.norm(local, axis=-1)
            depths[wide] = np.where(-local[:, 2] >= least * length, np.abs(local).max(-1), -length)
        return depths

    def directions(self, camera: int, shares: Array) -> Array:
        """Directions [N, 3], in axes of a camera and of depth 1, through positions [N, 2] in its image: x and y as
        shares of the image's sides, also slightly beyond the borders."""
        if self.lens is None:
            (fx, fy, cx, cy), (w, h) = self.intrinsics[camera], self.sizes[camera]
            x, y = (shares[:, 0] * w - cx) / fx, (shares[:, 1] * h - cy) / fy
            return np.stack([x, -y, -np.ones_like(x)], -1)
        grid = self.lens[camera]
        at = shares * (len(grid) - 1)
        first = np.clip(np.floor(at).astype(int), 0, len(grid) - 2)
        (x, y), (u, v) = first.T, (at - first).T[..., None]
        directions = (1 - v) * ((1 - u) * grid[y, x] + u * grid[y, x + 1])
        directions += v * ((1 - u) * grid[y + 1, x] + u * grid[y + 1, x + 1])
        depth = np.abs(directions).max(-1) if self.wide[camera] else -directions[:, 2]
        return directions / depth[:, None]

    def project(self, cameras: NDArray[np.int64], points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels [Q, 2] of points [Q, 3] in cameras [Q], without lens distortion, and mask of the points that lie
        ahead."""
        poses = self.camera_to_worlds[cameras]
        local = np.einsum("qji,qj->qi", poses[:, :, :3], points - poses[:, :, 3])
        ahead = local[:, 2] < 0
        depth = np.where(ahead, -local[:, 2], 1.0)
        fx, fy, cx, cy = self.intrinsics[cameras].T
        return np.stack([fx * local[:, 0] / depth + cx, cy - fy * local[:, 1] / depth], -1), ahead


@dataclass(frozen=True)
class VisiblePoints:
    """Weighted observations of placement: points, and the cameras that see them."""

    cameras: NDArray[np.int64]
    """[Q] camera of each observation."""
    points: Array
    """[Q, 3] observed point."""
    weights: Array
    """[Q] weight of each observation; those of a camera sum to 1."""
    nearest: Array
    """[M] depth, along each camera's axis, at which its points start."""
    typical: Array
    """[M, 2] depths below which a quarter and nine tenths of each camera's points lie."""
    near: float
    """Depth at which points start, over all cameras."""


def find_visible_points(observations: Observations) -> VisiblePoints:
    """Weighted observations: keypoints, and points that fill the cameras' frusta.

    Keypoints that are not finite or lie behind their camera are dropped. Without any, content is assumed to start at a
    tenth of the cameras' spread. Raises InputError if there are keypoints, and none of them can be used.
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
    # Evenly spaced in order of depth, which does not depend on numbering, pose or unit.
    order = np.argsort(observations.depths(cameras, points) / near, kind="stable")
    sampled = min(len(order), max(SAMPLED, SAMPLED_PER_CAMERA * len(centers)))
    keep = order[np.linspace(0, len(order) - 1, sampled).round().astype(int)]
    cameras, points = cameras[keep], points[keep]
    seen = np.bincount(cameras, minlength=len(centers))
    share = (1 - FRUSTUM_SHARE) * seen / (seen + FEW)
    # Points of a frustum are uniform in pixels and in disparity, by a sequence that is the same each time.
    uvw = np.stack([(np.arange(FILLING) * g) % 1.0 for g in (0.7548776662, 0.5698402910, 0.8191725134)], -1)
    clouds = [points]
    for i, pose in enumerate(observations.camera_to_worlds):
        depth = nearest[i] / np.maximum(uvw[:, 2], 1e-3)
        local = observations.directions(i, uvw[:, :2]) * depth[:, None]
        clouds.append(local @ pose[:, :3].T + pose[:, 3])
    return VisiblePoints(
        cameras=np.concatenate([cameras, np.repeat(np.arange(len(centers)), FILLING)]),
        points=np.concatenate(clouds),
        weights=np.concatenate([(share / np.maximum(seen, 1))[cameras], np.repeat((1 - share) / FILLING, FILLING)]),
        nearest=nearest,
        typical=typical,
        near=near,
    )


def pixels_per_pixel(observations: Observations, visible: VisiblePoints) -> float:
    """Number of training pixels, in all images together, that see the surface of one pixel; at least 1.

    An image counts by the square of its magnification relative to the observing one. Three quarters of the visible
    points are seen by at least this many pixels. Occlusion is not considered.
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

    Starts at the place farthest from the centre, so the numbering does not matter. Without a count, as many of the
    places [M, D] as needed for balls of ``radius`` around them to contain all.
    """
    chosen = [int(np.linalg.norm(places - places.mean(0), axis=-1).argmax())]
    distance = np.linalg.norm(places - places[chosen[0]], axis=-1)
    while distance.max() > radius if count is None else len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=-1))
    return chosen


def nearest_views(
    camera_to_worlds: NDArray[np.float64],
    i: int,
    count: int,
    max_angle: float = 180.0,
    among: Sequence[int] | NDArray[np.int64] | None = None,
    apart: bool = True,
) -> list[int]:
    """Cameras nearest to camera ``i`` with a similar viewing direction, nearest first.

    Args:
        camera_to_worlds: poses, axes in columns, z backwards or forwards. [M, 3, 4]
        max_angle: between viewing directions, degrees.
        among: the cameras to choose from; None for all.
        apart: only cameras in another place, whose images have a parallax.
    """
    others = np.arange(len(camera_to_worlds)) if among is None else np.asarray(among, np.int64)
    distance = np.linalg.norm(camera_to_worlds[others, :, 3] - camera_to_worlds[i, :, 3], axis=-1)
    usable = distance > APART * max(1.0, float(distance.max(initial=0.0))) if apart else others != i
    if max_angle < 180:
        usable &= camera_to_worlds[others, :, 2] @ camera_to_worlds[i, :, 2] > np.cos(np.radians(max_angle))
    order = np.argsort(np.where(usable, distance, np.inf), kind="stable")
    return others[order[: min(count, int(usable.sum()))]].tolist()


def _start(depth: Array) -> float:
    """Depth at which content starts (``FACTOR``, ``SUPPORT``); a lone outlier in front does not count."""
    ordered = np.sort(depth)
    inside = np.searchsorted(ordered, ordered * FACTOR, side="right") - np.arange(len(ordered))
    return float(ordered[np.argmax(inside >= max(1.0, SUPPORT * len(ordered)))])
