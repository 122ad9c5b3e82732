"""Visibility of points without tracks (``points3D`` of a data parser) in the training images.

A point cloud does not record which image saw a point, and projection alone would see through walls. Coarse depth images
of the cloud decide: a point is visible if no other one lies clearly in front of it, in its cell or a neighbouring one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import minimum_filter

from mmpi_ns.placement.observations import Observations

CELLS = 48
"""Cells of a coarse depth image along the longer side."""
BEHIND = 1.15
"""A point farther away than the nearest one around it by this factor is hidden."""


def with_visible_points(observations: Observations) -> Observations:
    """Keypoints of the observations' points in every camera that sees them; lens distortion is ignored."""
    seen_by, seen_point, seen_at = [observations.seen_by[:0]], [observations.seen_point[:0]], [np.zeros((0, 2))]
    for camera, (width, height) in enumerate(observations.sizes):
        cameras = np.full(len(observations.points), camera)
        at, ahead = observations.project(cameras, observations.points)
        depth = observations.depths(cameras, observations.points)
        chosen = np.nonzero(ahead & (at >= 0).all(-1) & (at[:, 0] < width) & (at[:, 1] < height))[0]
        cell = max(width, height) / CELLS
        columns, rows = (at[chosen] / cell).astype(int).T
        nearest = np.full((int(height / cell) + 1, int(width / cell) + 1), np.inf)
        np.minimum.at(nearest, (rows, columns), depth[chosen])
        nearest = minimum_filter(nearest, 3, mode="nearest")
        chosen = chosen[depth[chosen] < BEHIND * nearest[rows, columns]]
        seen_by.append(np.full(len(chosen), camera))
        seen_point.append(chosen)
        seen_at.append(at[chosen])
    return replace(
        observations,
        seen_by=np.concatenate(seen_by),
        seen_point=np.concatenate(seen_point),
        seen_at=np.concatenate(seen_at),
    )
