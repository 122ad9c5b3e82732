"""What placement knows about a scene: training cameras, SfM points and who saw what. Plain float64 NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Observations:
    """Training cameras and, where there is structure from motion, points and the pixels they were seen at."""

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

    @property
    def centers(self) -> Array:
        return self.camera_to_worlds[:, :, 3]

    @property
    def mean_axes(self) -> Array:
        """Rows x (right), y (down), z (facing) of the mean camera; gravity is the cameras' mean up vector.

        Only sums of camera axes enter, so a rotated scene gives the rotated frame. Where the cameras look every way
        the mean facing direction is ill-defined: the first camera's, made horizontal, stands in for it.
        """
        up = _unit(self.camera_to_worlds[:, :, 1].mean(0))
        mean_facing = -self.camera_to_worlds[:, :, 2].mean(0)
        facing = mean_facing if np.linalg.norm(mean_facing) > 0.3 else -self.camera_to_worlds[0, :, 2]
        right = np.cross(facing, up)
        if np.linalg.norm(right) < 1e-3:  # looking straight up or down: any horizontal axis will do
            right = self.camera_to_worlds[0, :, 0]
        right = _unit(right - right.dot(up) * up)
        return np.stack([right, -up, np.cross(right, -up)])

    def depths(self, cameras: NDArray[np.int64], points: Array) -> Array:
        """Depths [Q] of points [Q, 3] along the axes of cameras [Q]; negative behind."""
        poses = self.camera_to_worlds[cameras]
        return -np.einsum("qi,qi->q", points - poses[:, :, 3], poses[:, :, 2])

    def project(self, cameras: NDArray[np.int64], points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels [Q, 2] at which cameras [Q] would see points [Q, 3], lens distortion left out, and which lie ahead."""
        poses = self.camera_to_worlds[cameras]
        local = np.einsum("qji,qj->qi", poses[:, :, :3], points - poses[:, :, 3])
        ahead = local[:, 2] < 0
        depth = np.where(ahead, -local[:, 2], 1.0)
        fx, fy, cx, cy = self.intrinsics[cameras].T
        return np.stack([fx * local[:, 0] / depth + cx, cy - fy * local[:, 1] / depth], -1), ahead


def frustum_points(observations: Observations, near: Array, per_camera: int = 24) -> Array:
    """Points filling the camera frusta, uniform in pixels and in disparity; the last of each camera far away.

    Deterministic (a low-discrepancy sequence), so equal scenes give equal points.

    Args:
        observations: the cameras.
        near: [M] depth at which each camera's points start.
        per_camera: points of each camera.

    Returns:
        [M * per_camera, 3] camera after camera.
    """
    index = np.arange(per_camera)
    uvw = np.stack([(index * g) % 1.0 for g in (0.7548776662, 0.5698402910, 0.8191725134)], -1)
    clouds = []
    for pose, (fx, fy, cx, cy), (w, h), start in zip(
        observations.camera_to_worlds, observations.intrinsics, observations.sizes, near, strict=True
    ):
        depth = start / np.maximum(uvw[:, 2], 1e-3)
        x, y = (uvw[:, 0] * w - cx) / fx, (uvw[:, 1] * h - cy) / fy
        local = np.stack([x, -y, -np.ones_like(x)], -1) * depth[:, None]
        clouds.append(local @ pose[:, :3].T + pose[:, 3])
    return np.concatenate(clouds)


def _unit(v: Array) -> Array:
    return v / max(float(np.linalg.norm(v)), 1e-12)
