"""Image borders: MPIs are widened until the borders of every image, and a margin around them, lie in some MPI."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.placement.visibility import VisiblePoints
from mmpi_ns.scene.plan import MPIPlan

BEYOND = 0.05
"""Margin around an image that should have texels, as a fraction of its sides, because other views look there."""
WIDEST, FARTHEST = 3.0, 0.5
"""Limits on widened tangents, absolute and relative: a border far from all MPIs would cost too much."""


def widened(mpis: list[MPIPlan], observations: Observations, visible: VisiblePoints) -> list[MPIPlan]:
    """The MPIs, widened if the borders of an image lie in none of them; texels keep their size.

    A border is tested at the depths between which the image's points lie. Each border point outside all MPIs is
    assigned to the MPI that must grow least for it.

    Args:
        mpis: the chosen MPIs.
        observations: the training cameras.
        visible: points that they see.
    """
    points = border_points(observations, visible)
    origins = np.array([m.origin for m in mpis], dtype=np.float64)
    axes = np.array([m.axes for m in mpis], dtype=np.float64)
    local = np.einsum("kij,kpj->kpi", axes, points - origins[:, None])
    depths = local[..., 2]
    tangents = local[..., :2] / np.where(depths > 0, depths, np.nan)[..., None]
    extents = np.array([m.extent for m in mpis])
    ahead = (depths >= np.array([[m.near] for m in mpis])) & (depths <= np.array([[m.far] for m in mpis]))
    held = ahead & (_outside(tangents, extents).max(-1) <= 0)
    able = ahead & (np.abs(tangents).max(-1) <= WIDEST) & (_outside(tangents, extents).max(-1) <= FARTHEST)
    for p in np.nonzero(~held.any(0) & able.any(0))[0]:
        missing = np.maximum(_outside(tangents[:, p], extents), 0)
        k = int(np.where(able[:, p], missing.sum(-1), np.inf).argmin())
        u, v = tangents[k, p]
        u0, u1, v0, v1 = extents[k]
        extents[k] = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    result = []
    for mpi, (u0, u1, v0, v1) in zip(mpis, extents.tolist(), strict=True):
        across, down = (u1 - u0) / (mpi.extent[1] - mpi.extent[0]), (v1 - v0) / (mpi.extent[3] - mpi.extent[2])
        width, height = round((mpi.width - 1) * across) + 1, round((mpi.height - 1) * down) + 1
        result.append(replace(mpi, extent=(u0, u1, v0, v1), width=width, height=height))
    return result


def border_points(observations: Observations, visible: VisiblePoints) -> Array:
    """[M * 32, 3] points around every image's border, at the depths where a quarter and most of its points begin."""
    steps = (0.0, 0.25, 0.5, 0.75, 1.0)
    rim = np.array([(a, b) for a in steps for b in steps if a in (0.0, 1.0) or b in (0.0, 1.0)])
    shares = -BEYOND + (1 + 2 * BEYOND) * rim
    clouds = []
    for i, (pose, depths) in enumerate(zip(observations.camera_to_worlds, visible.typical, strict=True)):
        directions = observations.directions(i, shares) @ pose[:, :3].T
        clouds += [pose[:, 3] + depth * directions for depth in depths]
    return np.concatenate(clouds)


def _outside(tangents: Array, extents: Array) -> Array:
    """[K, ..., 2] how far tangents lie outside the extents [K, 4]; negative inside, not a number behind."""
    shape = (len(extents), *(1,) * (tangents.ndim - 2))
    u0, u1, v0, v1 = (extents[:, i].reshape(shape) for i in range(4))
    u, v = tangents[..., 0], tangents[..., 1]
    return np.stack([np.maximum(u0 - u, u - u1), np.maximum(v0 - v, v - v1)], -1)
