"""How far each MPI of a plan reaches: to infinity, or only as far as it is worth the rays that would meet it.

An MPI to infinity is met by the rays of every camera that faces its way, however far behind or ahead: on a road, all
MPIs by all rays. But from some depth on others show the same content. A further MPI must gain ``min_gain`` bits
(``rule.py``); so must, in proportion, a part of one: what lies beyond a depth is given up where others hold all of it
and the loss is fewer bits than the part's share of the rays that meet the MPI asks for. Nothing that was held is left
unheld, in content or in a lattice of points out to infinity, and ends that spare few rays are not worth a seam.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from mmpi_ns.placement.errors import WORST, mpi_errors
from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.placement.visibility import VisiblePoints
from mmpi_ns.scene.geometry import Frames, plane_hits
from mmpi_ns.scene.plan import MPIPlan

ENDS = 2.0 ** np.arange(1, 8, 0.5)
"""Depths at which an MPI may end, relative to where content starts; beyond, only infinity."""
INFINITE = 1000.0
"""Depth, relative to where content starts, that stands for infinity: there parallax cannot be told any more."""
LATTICE = ((0.0, 0.25, 0.5, 0.75, 1.0), (0.0, 0.5, 1.0), (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, INFINITE))
"""Columns, rows and depths (relative to where its content starts) at which each image must stay held."""
LEAST_DEPTH = 1.5
"""No MPI ends before so many times the depth of its first plane."""
LEAST_SPARED = 0.1
"""An end must spare an MPI this share of the training rays that meet it."""


def with_far_ends(
    mpis: list[MPIPlan],
    observations: Observations,
    visible: VisiblePoints,
    enough: float,
    max_planes: int,
    min_gain: float,
) -> list[MPIPlan]:
    """The MPIs, each with the depth at which it ends; poses, extents, planes and texels as they were.

    What some MPI held, of the content and of a lattice of points that fills each image's frustum out to infinity, some
    MPI still holds.

    Args:
        mpis: the chosen MPIs, all to infinity.
        observations: the training cameras.
        visible: what they see.
        enough: expected error that is small enough, in pixels.
        max_planes: planes with which expected errors are worked out.
        min_gain: bits that an MPI must gain.
    """
    if len(mpis) == 1:
        return mpis
    lattice_cameras, lattice, directions = lattice_points(observations, visible)
    bits, reach = _costs(mpis, observations, visible, (visible.cameras, visible.points), enough, max_planes)
    held, lattice_reach = _costs(mpis, observations, visible, (lattice_cameras, lattice), enough, max_planes)
    met = _rays_met(mpis, observations, visible, directions)
    least = np.searchsorted(ENDS * visible.near, LEAST_DEPTH * np.array([m.near for m in mpis]))
    choice = _Ends(bits, reach, visible.weights, lattice_reach, np.isfinite(held), met, least, min_gain)
    ends = np.append(ENDS * visible.near, np.inf)
    return [replace(m, far=float(ends[level])) for m, level in zip(mpis, choice.run(), strict=True)]


def lattice_points(observations: Observations, visible: VisiblePoints) -> tuple[NDArray[np.int64], Array, Array]:
    """Cameras [P] and places [P, 3] of points that fill each image's frustum, and directions [M, N, 3] to them."""
    columns, rows, depths = LATTICE
    shares = np.array([(a, b) for a in columns for b in rows])
    fx, fy, cx, cy = (observations.intrinsics[:, i, None] for i in range(4))
    x = (shares[:, 0] * observations.sizes[:, :1] - cx) / fx
    y = (shares[:, 1] * observations.sizes[:, 1:] - cy) / fy
    local = np.stack([x, -y, -np.ones_like(x)], -1)
    directions = np.einsum("mij,mnj->mni", observations.camera_to_worlds[:, :, :3], local)
    offsets = directions[:, None] * (visible.nearest[:, None] * np.array(depths))[:, :, None, None]
    points = observations.centers[:, None, None] + offsets
    cameras = np.repeat(np.arange(len(points)), points.shape[1] * points.shape[2])
    return cameras, points.reshape(-1, 3), directions


def _costs(
    mpis: list[MPIPlan],
    observations: Observations,
    visible: VisiblePoints,
    seen: tuple[NDArray[np.int64], Array],
    enough: float,
    max_planes: int,
) -> tuple[Array, NDArray[np.int64]]:
    """Bits [K, P] that each point costs in each MPI (inf where it is not held), and the least end that holds it."""
    cameras, points = seen
    bits, levels = [], []
    far_off = np.linalg.norm(points - observations.centers[cameras], axis=-1) > 0.5 * INFINITE * visible.near
    for mpi in mpis:
        plane, texel = mpi_errors(replace(mpi, planes=max_planes), observations, cameras, points)
        depth = (points - np.asarray(mpi.origin)) @ np.asarray(mpi.axes[2])
        # Half a spacing off at most; beyond the last finite plane no farther than infinity is.
        half = 0.5 / (mpi.near * (max_planes - 1))
        nearer = np.where(far_off, 0.0, np.minimum(1.0, 1 / (np.maximum(depth, mpi.near) * half)))
        held = np.isfinite(plane)
        error = np.hypot(np.where(held, plane, 0.0) * nearer, 0.5 * np.where(held, texel, 0.0))
        clipped = np.log2(np.clip(error, enough, max(WORST, 2 * enough)) / enough)
        bits.append(np.where(held, clipped, np.inf))
        levels.append(np.searchsorted(ENDS * visible.near, depth))
    return np.stack(bits), np.stack(levels)


def _rays_met(mpis: list[MPIPlan], observations: Observations, visible: VisiblePoints, directions: Array) -> Array:
    """[K, ends] how many of the lattice's rays meet each MPI if it ends there."""
    origins = np.repeat(observations.centers, directions.shape[1], 0)
    unit = directions.reshape(-1, 3) / np.linalg.norm(directions.reshape(-1, 3), axis=-1, keepdims=True)
    frames = Frames.pack(mpis, dtype=torch.float64)
    near = torch.zeros(len(unit), 1, dtype=torch.float64)
    hits = plane_hits(torch.from_numpy(origins), torch.from_numpy(unit), near, near + torch.inf, frames)
    nearest = (hits.m_first * frames.disparity_steps).numpy()
    first = np.searchsorted(ENDS * visible.near, 1 / np.maximum(nearest, 1e-300))
    met = (hits.count > 0).numpy()
    return np.stack(
        [np.cumsum(np.bincount(first[met[:, k], k], minlength=len(ENDS) + 1)) for k in range(len(mpis))]
    ).astype(np.float64)


@dataclass
class _Ends:
    """Greedy choice of ends: what saves most rays for its loss first, while every loss is worth it."""

    bits: Array
    """[K, Q] cost of each observation in each MPI; inf where not held."""
    reach: NDArray[np.int64]
    """[K, Q] the least end (index) that holds it."""
    weights: Array
    lattice_reach: NDArray[np.int64]
    """[K, P] the same for points that must stay held, whatever they cost."""
    lattice_held: NDArray[np.bool_]
    met: Array
    """[K, E] rays that meet each MPI for each end."""
    least: NDArray[np.int64]
    """[K] the least end of each MPI that lies beyond its first plane."""
    min_gain: float

    def run(self) -> NDArray[np.int64]:
        """Index of each MPI's end; the last is infinity."""
        count, infinity = len(self.bits), self.met.shape[1] - 1
        level = np.full(count, infinity)
        while True:
            loss = self._losses(level)
            spared = self.met[np.arange(count), level][:, None] - self.met
            price = self.met[:, -1:] / self.min_gain
            end = np.arange(infinity + 1)
            possible = (end < level[:, None]) & (end >= self.least[:, None])
            net = np.where(possible, spared - loss * price, -np.inf)
            k, end = np.unravel_index(int(net.argmax()), net.shape)
            if not net[k, end] > 0:
                break
            level[k] = end
        few = self.met[:, -1] - self.met[np.arange(count), level] < LEAST_SPARED * self.met[:, -1]
        return np.where(few, infinity, level)

    def _losses(self, level: NDArray[np.int64]) -> Array:
        """[K, E] bits lost if one MPI ended earlier; inf where something would be held no more."""
        active = np.where(self.reach <= level[:, None], self.bits, np.inf)
        owner = active.argmin(0)
        columns = np.arange(active.shape[1])
        best = active[owner, columns]
        active[owner, columns] = np.inf
        extra = np.where(np.isfinite(best), active.min(0) - np.where(np.isfinite(best), best, 0.0), 0.0)
        held = self.lattice_held & (self.lattice_reach <= level[:, None])
        alone = held.sum(0) == 1
        losses = np.zeros_like(self.met)
        ends = self.met.shape[1]
        for k in range(len(level)):
            own = owner == k
            per_end = np.bincount(self.reach[k, own], self.weights[own] * extra[own], minlength=ends)
            needed = self.lattice_reach[k, alone & held[k]].max(initial=-1)
            losses[k, :-1] = per_end[:0:-1].cumsum()[::-1]  # what lies beyond each end
            losses[k, : max(needed, 0)] = np.inf
        return losses
