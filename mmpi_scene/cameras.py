"""Cameras of a procedural scene: rays through pixels and pixels of points, with lens distortion, in float64."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NEWTON_STEPS, CONVERGED = 20, 1e-14
"""Maximum number of Newton steps for the inverse of the distortion, and the step (a tangent) at which they end."""


@dataclass(frozen=True)
class Cameras:
    """M cameras that share their intrinsics. Pixel centres lie at half integers."""

    camera_to_worlds: Array
    """[M, 3, 4], OpenGL axes (x right, y up, z backwards), metres."""
    focal: float
    """Pixels."""
    width: int
    height: int
    test_every: int
    """Each n-th image is held out."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2 of OpenCV's lens model; zeros: a pinhole."""

    def __len__(self) -> int:
        return len(self.camera_to_worlds)

    @property
    def center(self) -> tuple[float, float]:
        """(cx, cy), pixels."""
        return self.width / 2, self.height / 2

    @property
    def is_test(self) -> NDArray[np.bool_]:
        """[M] mask of the held-out images."""
        return np.arange(len(self)) % self.test_every == self.test_every // 2

    @cached_property
    def pixel_centers(self) -> Array:
        """[H * W, 2] (x, y), row after row."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([x, y], -1).reshape(-1, 2)

    @cached_property
    def central_tangents(self) -> Array:
        """[H * W, 2] tangents of the pixel centres, row after row."""
        return self.tangents(self.pixel_centers)

    def tangents(self, pixels: Array) -> Array:
        """Tangents [N, 2] (right, down) of the rays of pixels [N, 2]."""
        distorted = (pixels - self.center) / self.focal
        if not any(self.distortion):
            return distorted
        tangents = distorted
        for _ in range(NEWTON_STEPS):
            bent, (xx, xy, yy) = self._distort(tangents)
            wrong = distorted - bent
            step = np.stack([yy * wrong[:, 0] - xy * wrong[:, 1], xx * wrong[:, 1] - xy * wrong[:, 0]], -1)
            step /= (xx * yy - xy * xy)[:, None]
            tangents = tangents + step
            if not np.abs(step).max(initial=0.0) > CONVERGED:
                break
        return tangents

    def _distort(self, tangents: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        """Distorted tangents [N, 2], and their derivatives: of x by x, of x by y (and y by x), of y by y; each [N]."""
        k1, k2, p1, p2 = self.distortion
        x, y = tangents.T
        square = x * x + y * y
        radial, growth = 1 + square * (k1 + square * k2), k1 + 2 * square * k2
        bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
        bent_y = y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y)
        of_x = radial + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x
        of_both = 2 * x * y * growth + 2 * p1 * x + 2 * p2 * y
        of_y = radial + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x
        return np.stack([bent_x, bent_y], -1), (of_x, of_both, of_y)

    def rays(self, camera: int, pixels: Array) -> tuple[Array, Array]:
        """Origins and unit directions [N, 3] of the rays through pixels [N, 2]."""
        return self.rays_at(camera, self.tangents(pixels))

    def rays_at(self, camera: int, tangents: Array) -> tuple[Array, Array]:
        """Origins and unit directions [N, 3] of the rays at tangents [N, 2]."""
        pose = self.camera_to_worlds[camera]
        local = np.stack([tangents[:, 0], -tangents[:, 1], -np.ones(len(tangents))], -1)
        directions = local @ pose[:, :3].T / np.sqrt((local**2).sum(-1, keepdims=True))
        return np.broadcast_to(pose[:, 3], directions.shape), directions

    def project(self, camera: int | NDArray[np.int64], points: Array) -> tuple[Array, Array]:
        """Pixels [N, 2] of world points [N, 3] in a camera, or each in its own [N], and their depths [N] along the
        optical axis (negative: behind)."""
        poses = self.camera_to_worlds[camera]
        local = np.einsum("...ji,...j->...i", poses[..., :3], points - poses[..., 3])
        depth = -local[:, 2]
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        tangents = np.stack([local[:, 0], -local[:, 1]], -1) / safe[:, None]
        if any(self.distortion):
            # Beyond the corners the polynomial would fold back into the image: from there on it is extended straight.
            corners = np.array([[x, y] for x in (0.0, self.width) for y in (0.0, self.height)])
            widest = 1.05 * float(np.linalg.norm(self.tangents(corners), axis=-1).max())
            shrink = np.maximum(np.linalg.norm(tangents, axis=-1, keepdims=True) / widest, 1)
            tangents = self._distort(tangents / shrink)[0] * shrink
        return tangents * self.focal + self.center, depth


@dataclass(frozen=True)
class Panoramas(Cameras):
    """M equirectangular views, twice as wide as high: ahead is in the middle, the tangents of a pixel are its angles to
    the right and downwards, and ``focal`` is pixels a radian. There is no ``project``."""

    @classmethod
    def of(cls, cameras: Cameras) -> Panoramas:
        """As wide views as others, from the same places."""
        width, height = cameras.width // 2 * 2, cameras.width // 2
        return cls(cameras.camera_to_worlds, width / (2 * np.pi), width, height, cameras.test_every)

    def rays_at(self, camera: int, tangents: Array) -> tuple[Array, Array]:
        pose, (right, down) = self.camera_to_worlds[camera], tangents.T
        local = np.stack([np.cos(down) * np.sin(right), -np.sin(down), -np.cos(down) * np.cos(right)], -1)
        directions = local @ pose[:, :3].T
        return np.broadcast_to(pose[:, 3], directions.shape), directions
