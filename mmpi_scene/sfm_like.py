"""Points and tracks as structure from motion would find them, with as much noise and as many outliers as asked.

A track contains the cameras that see its point (by the exact distance along the ray). Its keypoints are noisy, and its
point is triangulated from them: uncertain along the road, as in a real capture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mmpi_scene.primitives import Array, dot
from mmpi_scene.scene import Scene

MIN_TRACK = 3
"""Minimum number of cameras that see a point."""
MIN_ANGLE = 0.5
"""Minimum triangulation angle, degrees."""
ROUNDS = 6
"""Maximum number of times that more points are drawn if too few are visible."""


@dataclass(frozen=True)
class SfmPoints:
    """P points and their Q keypoints, sorted by point and then by camera."""

    points: Array
    """[P, 3] as triangulated from the noisy keypoints, metres."""
    true_points: Array
    """[P, 3] on the surfaces that the cameras saw."""
    colors: NDArray[np.uint8]
    """[P, 3]"""
    outlier: NDArray[np.bool_]
    """[P] matched wrongly: far from the surface, yet its keypoints agree with it."""
    camera: NDArray[np.int64]
    """[Q]"""
    point: NDArray[np.int64]
    """[Q]"""
    pixel: Array
    """[Q, 2] (x, y)"""


def sfm_points(scene: Scene, count: int, noise_pixels: float = 0.3, outliers: float = 0.02) -> SfmPoints:
    """Points on visible surfaces, with their keypoints; fewer than ``count`` if too few are seen from enough
    directions. Raises ValueError if a number is out of range.

    Args:
        noise_pixels: standard deviation of the keypoints' noise along x and along y.
        outliers: share of the points that are wrong.
    """
    if count < 0 or noise_pixels < 0 or not 0 <= outliers < 1:
        raise ValueError(
            f"Points ({count}) and noise ({noise_pixels}) must not be negative, outliers ({outliers}) lie in [0, 1)."
        )
    random = np.random.default_rng([scene.seed, 5])
    points, colors, exact = np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 2))
    camera = point = np.zeros(0, np.int64)
    for _ in range(ROUNDS):
        missing = count - len(points)
        if missing <= 0:
            break
        more, more_colors, (cameras, rows, pixels) = _tracked(scene, int(missing * 1.5) + 16, random)
        camera, point = np.concatenate([camera, cameras]), np.concatenate([point, rows + len(points)])
        exact = np.concatenate([exact, pixels])
        points, colors = np.concatenate([points, more]), np.concatenate([colors, more_colors])
    thinned = np.zeros(len(points), bool)  # evenly, to ``count``
    thinned[np.linspace(0, len(points) - 1, min(count, len(points))).round().astype(int)] = True
    keep = thinned[point]
    camera, point, exact = camera[keep], (np.cumsum(thinned) - 1)[point[keep]], exact[keep]
    points, colors = points[thinned], colors[thinned]
    pixel = exact + noise_pixels * random.standard_normal(exact.shape)
    moved, outlier, keep, pixel = _misled(scene, points, (camera, point, exact), pixel, outliers, random)
    placed = _triangulated(scene, moved, camera[keep], point[keep], pixel[keep])
    return SfmPoints(placed, points, colors, outlier, camera[keep], point[keep], pixel[keep])


def visible(scene: Scene, camera: int, points: Array) -> tuple[NDArray[np.bool_], Array]:
    """Whether a camera sees points [N, 3] (in the image, in range, nothing in front), and where [N, 2]."""
    cameras = scene.cameras
    pixel, depth = cameras.project(camera, points)
    offset = points - cameras.camera_to_worlds[camera, :, 3]
    distance = np.sqrt(dot(offset, offset))
    seen = (depth > 1e-6) & (distance < scene.track_range)
    seen &= ((pixel > 0) & (pixel < [cameras.width, cameras.height])).all(-1)
    rows = np.flatnonzero(seen)
    directions = offset[rows] / distance[rows, None]
    hit = scene.filmed_by(camera).hit(
        np.broadcast_to(cameras.camera_to_worlds[camera, :, 3], directions.shape), directions
    )[0]
    seen[rows] = hit >= distance[rows] - 1e-5 * (1 + distance[rows])
    return seen, pixel


def _tracked(scene: Scene, count: int, random: np.random.Generator) -> tuple:
    """Points [P, 3] at random pixels, their colours, and the (camera, point, exact pixel) of tracks worth keeping."""
    drawn = np.sort(random.integers(len(scene.cameras), size=count))
    pixels = random.uniform(0, 1, (count, 2)) * [scene.cameras.width, scene.cameras.height]
    parts = []
    for i in np.unique(drawn):
        origins, directions = scene.cameras.rays(i, pixels[drawn == i])
        distance, color = scene.trace(origins, directions, 1 / scene.cameras.focal)
        near = distance < scene.track_range
        surface = origins[near] + distance[near, None] * directions[near]
        parts.append((surface, (color[near] * 255).round().astype(np.uint8)))
    points, colors = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(points[:, 0], kind="stable")
    points, colors = points[order], colors[order]
    cameras, rows, pixels = [], [], []
    for i, x in enumerate(scene.cameras.camera_to_worlds[:, 0, 3]):
        near = slice(*np.searchsorted(points[:, 0], [x - scene.track_range, x + scene.track_range]))
        seen, pixel = visible(scene, i, points[near])
        cameras.append(np.full(seen.sum(), i))
        rows.append(np.flatnonzero(seen) + near.start)
        pixels.append(pixel[seen])
    camera, point, pixel = (np.concatenate(x) for x in (cameras, rows, pixels))
    order = np.lexsort((camera, point))
    camera, point, pixel = camera[order], point[order], pixel[order]
    rays = scene.cameras.camera_to_worlds[camera, :, 3] - points[point]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    first, cosine = np.searchsorted(point, np.arange(len(points))), np.full(len(points), 1.0)
    np.minimum.at(cosine, point, dot(rays, rays[first[point]]))
    good = (np.bincount(point, minlength=len(points)) >= MIN_TRACK) & (cosine <= np.cos(np.radians(MIN_ANGLE)))
    kept = good[point]
    return points[good], colors[good], (camera[kept], (np.cumsum(good) - 1)[point[kept]], pixel[kept])


def _misled(scene: Scene, points: Array, tracks: tuple, pixel: Array, share: float, random: np.random.Generator):
    """Points [P, 3], of which a share was moved along a camera's ray, with keypoints that agree, as by a repeated
    pattern; which those are [P], which keypoints remain [Q] and where [Q, 2]."""
    camera, point, exact = tracks
    moved, outlier, keep = points.copy(), np.zeros(len(points), bool), np.ones(len(point), bool)
    count = round(share * len(points))
    if not count:
        return moved, outlier, keep, pixel
    first = camera[np.searchsorted(point, np.arange(len(points)))]
    center = scene.cameras.camera_to_worlds[first, :, 3]
    stretch = np.exp(random.uniform(0.25, 0.9, len(points)) * random.choice([-1, 1], len(points)))
    wrong = center + (points - center) * stretch[:, None]
    where, depth = scene.cameras.project(camera, wrong[point])
    size = [scene.cameras.width, scene.cameras.height]
    inside = (depth > 0) & ((where > 0) & (where < size)).all(-1)
    able = np.flatnonzero(np.bincount(point, inside, minlength=len(points)) >= MIN_TRACK)
    outlier[random.permutation(able)[:count]] = True
    moved[outlier] = wrong[outlier]
    of_outlier = outlier[point]
    return moved, outlier, ~of_outlier | inside, np.where(of_outlier[:, None], where + pixel - exact, pixel)


def _triangulated(scene: Scene, points: Array, camera: NDArray, point: NDArray, pixel: Array) -> Array:
    """Points [P, 3] of least squared reprojection error, by Gauss-Newton from the true ones."""
    if not len(points):
        return points
    # As pinholes see it: the noise is far below what a lens changes over it.
    pinholes = replace(scene.cameras, distortion=(0.0, 0.0, 0.0, 0.0))
    if any(scene.cameras.distortion):
        pixel = scene.cameras.tangents(pixel) * pinholes.focal + pinholes.center
    axes = pinholes.camera_to_worlds[camera, :, :3]
    starts = np.searchsorted(point, np.arange(len(points)))
    points = points.copy()
    for _ in range(4):
        where, depth = pinholes.project(camera, points[point])
        slope = (where - pinholes.center) / pinholes.focal
        # d(x, y)/d(point): the image axes less what moving along the optical axis does.
        right, down, ahead = axes[:, :, 0], -axes[:, :, 1], -axes[:, :, 2]
        jacobian = np.stack([right - slope[:, :1] * ahead, down - slope[:, 1:] * ahead], 1)
        jacobian *= pinholes.focal / depth[:, None, None]
        normal = np.add.reduceat(np.einsum("qki,qkj->qij", jacobian, jacobian), starts)
        gradient = np.add.reduceat(np.einsum("qki,qk->qi", jacobian, pixel - where), starts)
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        # A step of more than a tenth of the distance leaves where the linearisation holds.
        far = np.linalg.norm(points - pinholes.camera_to_worlds[camera[starts], :, 3], axis=-1)
        size = np.linalg.norm(step, axis=-1)
        points += step * np.minimum(1, 0.1 * far / np.maximum(size, 1e-12))[:, None]
    return points
