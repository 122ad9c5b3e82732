"""Where MPIs and the cube might stand: a generous list, from which ``rule.py`` chooses.

Three kinds. *Views* are frusta of training cameras, some pulled back, some widened: seen from its own origin an MPI has
no plane error and texels as fine as pixels. *Sides* face left, right, down or up from a training camera's place, some
from behind it: one of them may hold the whole side of a drive, on planes parallel to what stands there. *Cubes*
surround what the cameras look at, or the cameras.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mmpi_ns.placement.content import Content
from mmpi_ns.placement.errors import pixel_slopes
from mmpi_ns.placement.hand_made import vector
from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.placement.plan import CubePlan, MPIPlan

MAX_VIEWS, MAX_SIDES = 96, 24
"""Training cameras that candidates start from, spread over all of them."""
MARGINS = (1.12, 1.4, 1.75)
"""Frusta of views, relative to the camera's own."""
PULL_BACKS = (0.0, 1.0, 2.0)
"""How far behind the camera an MPI may stand, relative to where content starts."""
NEAR_SHARE = 0.6
"""First plane, relative to where content starts."""
WIDEST = 9.0
"""No tangent of a side is larger."""
CUBE_SIZES = (0.4, 0.7, 1.0)
"""Half a cube's side, relative to the cameras' distance from what they look at."""


@dataclass(frozen=True)
class Fineness:
    """How fine candidates are made."""

    texel_pixels: float
    """Image pixels that a texel spans, seen from where the MPI stands."""
    planes: int
    """Planes of each."""
    max_voxels: int
    """Voxels along a side of the cube at most; 0 for no cube."""


def mpi_candidates(observations: Observations, content: Content, fineness: Fineness) -> list[MPIPlan]:
    """Views and sides at training cameras that are spread over the capture."""
    spread = spread_cameras(observations, content, MAX_VIEWS)
    views = [
        _view(observations, content, fineness, int(i), pull_back * content.near, margin)
        for i in spread
        for pull_back in PULL_BACKS
        for margin in MARGINS
    ]
    return [*views, *_sides(observations, content, fineness, spread[:MAX_SIDES])]


def spread_cameras(observations: Observations, content: Content, wanted: int) -> Array:
    """Cameras far apart in place or direction, each the farthest from those before it.

    Starts at the camera farthest from the middle, so the numbering of the cameras does not matter.
    """
    reach = max(content.near, 1e-12)
    place = np.concatenate([observations.centers / reach, observations.camera_to_worlds[:, :, 2] * 2], -1)
    distance = -np.linalg.norm(place - place.mean(0), axis=-1)
    chosen = [int(distance.argmin())]
    distance = np.full(len(place), np.inf)
    while len(chosen) < min(wanted, len(place)):
        distance = np.minimum(distance, np.linalg.norm(place - place[chosen[-1]], axis=-1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen)


def _view(
    observations: Observations, content: Content, fineness: Fineness, i: int, pull_back: float, margin: float
) -> MPIPlan:
    right, up, back = observations.camera_to_worlds[i, :, :3].T
    fx, fy, cx, cy = observations.intrinsics[i]
    width, height = observations.sizes[i]
    u, v = np.array([-cx, width - cx]) / fx, np.array([-cy, height - cy]) / fy
    u0, u1, v0, v1 = (float(x) for side in (u, v) for x in side.mean() + margin * (side - side.mean()))
    return MPIPlan(
        name=f"view {i + 1}",
        origin=vector(observations.centers[i] + pull_back * back),
        axes=(vector(right), vector(-up), vector(-back)),
        near=float(NEAR_SHARE * min(content.nearest[i], content.near) + pull_back),
        extent=(u0, u1, v0, v1),
        planes=fineness.planes,
        height=max(8, round((v1 - v0) * fy / fineness.texel_pixels) + 1),
        width=max(8, round((u1 - u0) * fx / fineness.texel_pixels) + 1),
    )


def _sides(observations: Observations, content: Content, fineness: Fineness, cameras: Array) -> Iterator[MPIPlan]:
    for i in cameras:
        right, up, back = observations.camera_to_worlds[int(i), :, :3].T
        turns = {
            "left": (-back, -up, -right),
            "right": (back, -up, right),
            "below": (right, back, -up),
            "above": (right, -back, up),
        }
        for name, axes in turns.items():
            for pull_back in PULL_BACKS:
                origin = observations.centers[int(i)] - pull_back * content.near * axes[2]
                side = _side(observations, content, fineness, f"{name} of view {int(i) + 1}", origin, np.stack(axes))
                if side is not None:
                    yield side


def _side(
    observations: Observations, content: Content, fineness: Fineness, name: str, origin: Array, axes: Array
) -> MPIPlan | None:
    """An MPI around what lies ahead of a frame; None where too little does.

    Its texels span the wanted number of pixels in the median over the observations that it holds.
    """
    local = (content.points - origin) @ axes.T
    ahead = np.nonzero((local[:, 2] > 0.2 * content.near) & (np.abs(local[:, :2]).max(-1) < WIDEST * local[:, 2]))[0]
    if len(ahead) < 0.02 * len(content.points):
        return None
    near = NEAR_SHARE * float(np.percentile(local[ahead, 2], 3))
    tangents = local[ahead, :2] / local[ahead, 2:]
    low, high = np.percentile(tangents, [2, 98], axis=0)
    margin = 0.05 * (high - low) + 1e-3
    (u0, v0), (u1, v1) = (low - margin).tolist(), (high + margin).tolist()
    frame = MPIPlan(name, vector(origin), tuple(vector(a) for a in axes), near, (u0, u1, v0, v1), 2, 2, 2)  # type: ignore
    _, across, down = pixel_slopes(frame, observations, content.cameras[ahead], content.points[ahead])
    held = np.isfinite(across)
    if not held.any():
        return None
    width, height = (
        max(8, round(extent * float(np.median(slope[held])) / fineness.texel_pixels) + 1)
        for extent, slope in ((u1 - u0, across), (v1 - v0, down))
    )
    return replace(frame, planes=fineness.planes, width=width, height=height)


def cube_candidates(observations: Observations, content: Content, fineness: Fineness) -> list[CubePlan]:
    """Cubes around the point that the cameras look at, where there is one, else around the cameras."""
    if fineness.max_voxels < 2:
        return []
    center, distance = _looked_at(observations)
    if center is None:
        center = observations.centers.mean(0)
        distance = float(np.linalg.norm(observations.centers - center, axis=-1).max()) + content.near
    cubes = []
    for half in (size * distance for size in CUBE_SIZES):
        seen = np.abs(content.points - center).max(-1) < half
        if not seen.any():
            continue
        poses = observations.camera_to_worlds[content.cameras[seen]]
        depth = -np.einsum("qi,qi->q", content.points[seen] - poses[:, :, 3], poses[:, :, 2])
        focal = observations.intrinsics[content.cameras[seen], 0]
        voxel = fineness.texel_pixels * float(np.median(depth / focal))
        side = int(np.clip(round(2 * half / voxel), 8, fineness.max_voxels))
        cubes.append(CubePlan(vector(center - half), vector(center + half), (side, side, side)))
    return cubes


def _looked_at(observations: Observations) -> tuple[Array | None, float]:
    """The point nearest to all viewing axes and its median distance; no point where most cameras do not face it."""
    forward = -observations.camera_to_worlds[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(0)
    if np.linalg.cond(total) > 1e4:  # all look the same way
        return None, 0.0
    point = np.linalg.solve(total, np.einsum("mij,mj->i", across, observations.centers))
    offset = point - observations.centers
    along = np.einsum("mi,mi->m", offset, forward)
    distance = np.linalg.norm(offset, axis=-1)
    if np.mean(along > 0.8 * distance) < 0.8:
        return None, 0.0
    return point, float(np.median(distance))
