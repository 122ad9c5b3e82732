"""A quick plane sweep: rough points for scenes that come with poses but without structure from motion.

Placement needs only rough depths. Some views are compared with their neighbours over a range of disparities at low
resolution; pixels with one clear match become points. Takes a few seconds.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter

from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.scene.near_views import nearest_views

REFERENCES = 16
"""Views that are swept, evenly spread over the capture."""
HYPOTHESES = 64
WINDOW = 7
MAX_ANGLE = 30.0
"""Degrees between the viewing directions of views that are compared."""
MIN_SCORE = 0.85
"""Minimum correlation of a match."""
MIN_MARGIN = 0.08
"""Minimum lead over every match at another depth."""


class _View(NamedTuple):
    image: Array
    pose: Array
    intrinsics: Array


def add_swept_points(observations: Observations, images: list[Array]) -> Observations:
    """The observations with points found by a plane sweep, each seen by its reference view and every near one it falls
    on. Earlier points, with or without keypoints, stay first. Images of all cameras are gray [h, w], in [0, 1], about
    128 pixels a side."""
    count, poses, pinholes = len(images), observations.camera_to_worlds, observations.intrinsics
    references = np.unique(np.linspace(0, count - 1, min(REFERENCES, count)).round().astype(int))
    scales = [image.shape[1] / width for image, width in zip(images, observations.sizes[:, 0], strict=True)]
    views = [_View(image, poses[i], pinholes[i] * scales[i]) for i, image in enumerate(images)]
    points, cameras, indices = [observations.points], [observations.seen_by], [observations.seen_point]
    total = len(observations.points)
    for i in references:
        neighbours = nearest_views(poses, int(i), 8, MAX_ANGLE)
        if not neighbours:
            continue
        swept = _sweep(views[i], [views[j] for j in neighbours[:4]])
        points.append(swept)
        for j in (int(i), *neighbours):
            pixels, ahead = observations.project(np.full(len(swept), j), swept)
            seen = np.nonzero(ahead & ((pixels >= 0) & (pixels < observations.sizes[j])).all(-1))[0]
            cameras.append(np.full(len(seen), j, np.int64))
            indices.append(total + seen)
        total += len(swept)
    seen_by, seen_point = np.concatenate(cameras), np.concatenate(indices)
    return replace(observations, points=np.concatenate(points), seen_by=seen_by, seen_point=seen_point)


def _sweep(reference: _View, neighbours: list[_View]) -> Array:
    """World points of the reference's pixels where one disparity matches clearly best."""
    height, width = reference.image.shape
    fx, fy, cx, cy = reference.intrinsics
    ys, xs = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([(xs - cx) / fx, -(ys - cy) / fy, -np.ones_like(xs)], -1)
    distances = [float(np.linalg.norm(n.pose[:, 3] - reference.pose[:, 3])) for n in neighbours]
    # The nearest neighbour sets how near points may be: on a walk the others have long turned away from it.
    baseline = max(min(distances), 0.1 * max(distances))
    disparities = np.linspace(0, 0.35 * width / (fx * baseline), HYPOTHESES)
    # Of each disparity the mean correlation of the better half of the neighbours.
    better = max(1, (len(neighbours) + 1) // 2)
    correlations = ([_correlation(reference, n, rays, w) for n in neighbours] for w in disparities)
    scores = np.stack([np.sort(np.stack(c), 0)[::-1][:better].mean(0) for c in correlations])
    best = scores.argmax(0)
    top = scores.max(0)
    level = np.arange(HYPOTHESES)[:, None, None]
    second = np.where(np.abs(level - best) > 3, scores, -1).max(0)
    good = (top > MIN_SCORE) & (top - second > MIN_MARGIN) & (best > 0)
    # The peak lies between the hypotheses, at the vertex of the parabola through the best and its neighbours.
    inner = np.clip(best, 1, HYPOTHESES - 2)[None]
    below, middle, above = (np.take_along_axis(scores, inner + d, 0)[0] for d in (-1, 0, 1))
    bend = below - 2 * middle + above
    is_peak = (bend < -1e-9) & (inner[0] == best)
    offset = np.where(is_peak, np.clip(0.5 * (below - above) / np.where(is_peak, bend, -1.0), -0.5, 0.5), 0.0)
    inverse_depth = np.where(good, (best + offset) * disparities[1], 1.0)
    world = (rays / inverse_depth[..., None]) @ reference.pose[:, :3].T + reference.pose[:, 3]
    return world[good][:: max(1, good.sum() // 400)]


def _correlation(reference: _View, neighbour: _View, rays: Array, disparity: float) -> Array:
    """Zero-mean normalised correlation, over windows, of the reference with the neighbour warped at a disparity; -1
    where a window leaves the neighbour or holds no texture."""
    direction = rays @ reference.pose[:, :3].T + disparity * (reference.pose[:, 3] - neighbour.pose[:, 3])
    local = direction @ neighbour.pose[:, :3]
    depth = -local[..., 2]
    ahead = depth > 1e-9
    safe = np.where(ahead, depth, 1.0)
    fx, fy, cx, cy = neighbour.intrinsics
    x, y = fx * local[..., 0] / safe + cx - 0.5, -fy * local[..., 1] / safe + cy - 0.5
    height, width = neighbour.image.shape
    inside = ahead & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    a, b = reference.image, map_coordinates(neighbour.image, np.where(inside, [y, x], 0.0), order=1)
    b, mean = np.where(inside, b, 0.0), partial(uniform_filter, size=WINDOW, mode="nearest")
    mean_a, mean_b = mean(a), mean(b)
    variance_a, variance_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    textured = (variance_a > 1e-4) & (variance_b > 1e-4) & (mean(inside.astype(float)) > 0.999)
    return np.where(textured, covariance / np.sqrt(np.maximum(variance_a * variance_b, 1e-12)), -1.0)
