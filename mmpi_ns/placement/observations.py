"""Input of placement: training cameras, SfM points and their keypoints. Plain float64 NumPy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

WIDE = 1.5
"""Tangent beyond which a lens that compresses its borders counts as wide: planes facing like the camera cover too
little of its field of view."""
SQUEEZED = 1.3
"""Such a lens sees farther than a pinhole of its focal length would, by this factor in tangents."""
BEYOND_LENS = 0.05
"""Cosines by which a keypoint may lie beyond the borders of its lens."""
FILLING = 24
"""Points that fill the frustum of a camera."""


@dataclass(frozen=True)
class Observations:
    """Training cameras and, if there is structure from motion, points and their keypoints."""

    camera_to_worlds: Array
    """[M, 3, 4], OpenGL axes (x right, y up, z backwards), scene units."""
    intrinsics: Array
    """[M, 4]: fx, fy, cx, cy in pixels."""
    sizes: Array
    """[M, 2]: width, height in pixels."""
    points: Array
    """[P, 3] SfM points in scene units; P may be 0."""
    seen_by: NDArray[np.int64]
    """[Q] camera of each keypoint; Q may be 0."""
    seen_point: NDArray[np.int64]
    """[Q] point of each keypoint."""
    seen_at: Array
    """[S, 2] pixel (x, y) of the first S <= Q keypoints, those of SfM; the others come from a plane sweep."""
    lens: Array | None = None
    """[M, G, G, 3] unit directions, in camera axes, through a grid over each image from border to border, row after
    row; None if all cameras are pinholes."""
    loose: Array | None = None
    """[L, 3] points of a cloud that does not record which images saw them (``capture/loose_points.py`` finds out)."""

    @staticmethod
    def of_cameras(camera_to_worlds: Array, intrinsics: ArrayLike, sizes: ArrayLike) -> Observations:
        """Cameras of which no point is known."""
        pinholes, none = np.array(intrinsics, np.float64), np.zeros(0, np.int64)
        seen = np.zeros((0, 3)), none, none, np.zeros((0, 2))
        return Observations(camera_to_worlds, pinholes, np.array(sizes, np.float64), *seen)

    @property
    def centers(self) -> Array:
        return self.camera_to_worlds[:, :, 3]

    @property
    def tracked(self) -> tuple[NDArray[np.int64], Array]:
        """Camera [S] and point [S, 3] of each keypoint of SfM; those of a plane sweep are too rough for depths."""
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
        """[M] which cameras see farther to the sides than planes in front of them can cover."""
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
        """Directions [N, 3], in camera axes and of depth 1, through places [N, 2] of an image.

        Args:
            camera: number of the camera.
            shares: x and y as shares of the image's sides; a little beyond the borders will do.
        """
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
        """Pixels [Q, 2] at which cameras [Q] would see points [Q, 3], lens distortion left out, and which lie ahead."""
        poses = self.camera_to_worlds[cameras]
        local = np.einsum("qji,qj->qi", poses[:, :, :3], points - poses[:, :, 3])
        ahead = local[:, 2] < 0
        depth = np.where(ahead, -local[:, 2], 1.0)
        fx, fy, cx, cy = self.intrinsics[cameras].T
        return np.stack([fx * local[:, 0] / depth + cx, cy - fy * local[:, 1] / depth], -1), ahead


def frustum_points(observations: Observations, near: Array) -> Array:
    """Points [M * FILLING, 3] that fill the camera frusta from depths ``near`` [M] on, camera after camera, uniform in
    pixels and in disparity; the last of each camera far away.

    Deterministic (a low-discrepancy sequence), so equal scenes give equal points.
    """
    index = np.arange(FILLING)
    uvw = np.stack([(index * g) % 1.0 for g in (0.7548776662, 0.5698402910, 0.8191725134)], -1)
    clouds = []
    for i, (pose, start) in enumerate(zip(observations.camera_to_worlds, near, strict=True)):
        depth = start / np.maximum(uvw[:, 2], 1e-3)
        local = observations.directions(i, uvw[:, :2]) * depth[:, None]
        clouds.append(local @ pose[:, :3].T + pose[:, 3])
    return np.concatenate(clouds)
