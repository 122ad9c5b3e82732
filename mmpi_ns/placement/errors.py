"""Expected pixel errors of a plan: displacement of a point due to the spacing of planes (e_p) and texels (e_t).

A point between two planes is represented on one of them, with an error of up to half a spacing in disparity; for a
camera away from the MPI's origin that is a shift in the image. A texel seen from closer than the MPI's origin spans
several pixels. Formulas for a camera parallel to the MPI are in docs/placement.md; here the projection is
differentiated instead, which holds for any pose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan

WORST = 64.0
"""Error of an observation that no head contains, and upper bound on all errors, pixels."""


def pixel_errors(plan: ScenePlan, observations: Observations, cameras: NDArray[np.int64], points: Array) -> Array:
    """Errors [Q, K] of observed points [Q, 3], each seen by a camera [Q], in every head of a plan: its MPIs, then the
    cube if there is one. A sample is displaced by at most e_p and half a texel: hypot of both; inf outside the head."""
    of_mpis = (mpi_errors(mpi, observations, cameras, points) for mpi in plan.mpis)
    errors = [np.hypot(plane, 0.5 * texel) for plane, texel in of_mpis]
    if plan.cube is not None:
        errors.append(0.5 * cube_errors(plan.cube, observations, cameras, points))
    return np.stack(errors, -1)


def mpi_errors(
    mpi: MPIPlan, observations: Observations, cameras: NDArray[np.int64], points: Array
) -> tuple[Array, Array]:
    """(e_p, e_t) of observed points in one MPI, in pixels; inf if it does not contain the point."""
    plane, across, down = pixel_slopes(mpi, observations, cameras, points)
    u0, u1, v0, v1 = mpi.extent
    texel = np.maximum(across * (u1 - u0) / (mpi.width - 1), down * (v1 - v0) / (mpi.height - 1))
    return 0.5 * plane * mpi.disparity_step, texel


def pixel_slopes(
    mpi: MPIPlan, observations: Observations, cameras: NDArray[np.int64], points: Array
) -> tuple[Array, Array, Array]:
    """Pixels [Q] that an observed point moves per unit of its disparity, tangent u and tangent v in an MPI's frame, inf
    if the MPI does not contain it. Independent of its planes and texels, which can be chosen by these slopes."""
    axes, origin = np.asarray(mpi.axes), np.asarray(mpi.origin)
    local = (points - origin) @ axes.T
    ahead = (local[:, 2] >= mpi.near) & (local[:, 2] <= mpi.far)
    z = np.where(ahead, local[:, 2], 1.0)
    u, v, w = local[:, 0] / z, local[:, 1] / z, 1 / z
    u0, u1, v0, v1 = mpi.extent
    inside = ahead & (u >= u0) & (u <= u1) & (v >= v0) & (v <= v1)

    poses = observations.camera_to_worlds[cameras]
    focal = observations.intrinsics[cameras][:, :2]
    to_camera = np.swapaxes(poses[:, :, :3], 1, 2)
    # The homogeneous point (u x + v y + z) + (origin - camera) w, in camera axes, is linear in (u, v, w).
    columns = np.einsum("qij,kj->qik", to_camera, axes)
    shift = np.einsum("qij,qj->qi", to_camera, origin - poses[:, :, 3])
    q = columns[..., 0] * u[:, None] + columns[..., 1] * v[:, None] + columns[..., 2] + shift * w[:, None]
    depth = -q[:, 2]  # OpenGL cameras look along -z
    seen = inside & (depth > 1e-9 * np.abs(q).max(-1))
    depth = np.where(seen, depth, 1.0)

    wide, slopes = observations.wide[cameras], []
    for direction in (shift, columns[..., 0], columns[..., 1]):  # of a unit step in disparity, u and v
        moved = direction[:, :2] / depth[:, None] + q[:, :2] * (direction[:, 2] / depth**2)[:, None]
        pixels = np.where(seen, np.linalg.norm(moved * focal, axis=-1), np.inf)
        if wide.any():  # such lenses have about as many pixels for each degree at the borders as in the middle
            some, size = direction[wide], np.linalg.norm(q[wide], axis=-1)
            turned = np.linalg.norm(np.cross(some, q[wide]), axis=-1) / np.maximum(size, 1e-12) ** 2
            pixels[wide] = np.where(inside[wide], turned * focal[wide].mean(-1), np.inf)
        slopes.append(pixels)
    return slopes[0], slopes[1], slopes[2]


def cube_errors(cube: CubePlan, observations: Observations, cameras: NDArray[np.int64], points: Array) -> Array:
    """e_t of observed points in a cube: the pixels that a voxel's longest side spans; inf outside the cube."""
    lower, upper = np.asarray(cube.lower), np.asarray(cube.upper)
    voxel = ((upper - lower) / np.array(cube.shape[::-1])).max()
    depth = observations.depths(cameras, points)
    seen = ((points >= lower) & (points <= upper)).all(-1) & (depth > 0)
    focal = observations.intrinsics[cameras][:, :2].max(-1)
    return np.where(seen, voxel * focal / np.where(seen, depth, 1.0), np.inf)
