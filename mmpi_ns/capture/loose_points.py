"""Points that come without tracks (``points3D`` of a data parser): which training image sees which of them.

A cloud does not say who saw a point, and an image would see points through walls. Coarse depth images of the cloud
itself tell: a point is seen where nothing of the cloud lies clearly before it, in its cell of the image or beside it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import minimum_filter

from mmpi_ns.placement.observations import Observations

CELLS = 48
"""Cells of a coarse depth image along the longer side."""
BEHIND = 1.15
"""A point further than the nearest about it by this factor is hidden."""


def with_visible_points(observations: Observations) -> Observations:
    """Keypoints for the observations' points wherever a camera sees one; the lens is left out."""
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
