"""Hand-made plans: a fixed arrangement for drives, as a baseline for automatic placement, and the paper's room."""

from __future__ import annotations

import numpy as np

from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan, Vector

OVERLAPPING = 1.25
"""Half the extent of each MPI of a room, a tangent: above 1 neighbours overlap."""


def vector(v: Array) -> Vector:
    return (float(v[0]), float(v[1]), float(v[2]))


def facing_axes(base: Array, name: str) -> tuple[Vector, Vector, Vector]:
    """Rows x, y, z of an MPI that faces ``name`` in a frame with rows right, down, forward."""
    right, down, forward = base
    x, y, z = {
        "front": (right, down, forward),
        "back": (-right, down, -forward),
        "left": (forward, down, -right),
        "right": (-forward, down, right),
        "below": (right, -forward, down),
        "above": (right, forward, -down),
    }[name]
    return vector(x), vector(y), vector(z)


def drive_plan(
    observations: Observations, metre: float, size: tuple[int, int, int], names: tuple[str, ...], pull_back: float
) -> ScenePlan:
    """Four MPIs along a straight drive, placed by hand in metres (fixed, as a baseline).

    Args:
        observations: training cameras; the drive runs along their mean direction.
        metre: scene units in a metre.
        size: planes of every MPI, and their texel rows and columns.
        names: which of the four to use.
        pull_back: distance of the front MPI behind the first camera, as a fraction of the travel.
    """
    base = observations.mean_axes
    centers = observations.centers @ base.T
    start = np.array([centers[:, 0].mean(), centers[:, 1].mean(), centers[:, 2].min()])
    travel = float(np.ptp(centers[:, 2])) / metre
    back = pull_back * travel
    # origin (right, down, forward) in metres from the first camera, near, tangents along the MPI's own x and y
    rule = {
        "front": ((0.0, 0.0, -back), back + 3, (-1.0, 1.0, -0.35, 0.35)),
        "left": ((8.0, 0.0, travel / 2), 10.0, (-2.5, 9.0, -0.7, 0.4)),
        "right": ((-8.0, 0.0, travel / 2), 10.0, (-9.0, 2.5, -0.7, 0.4)),
        "below": ((0.0, -4.0, travel / 2), 4.8, (-6.0, 6.0, -18.0, 6.0)),
    }
    mpis = []
    for name in names:
        origin, near, extent = rule[name]
        world = (start + np.array(origin) * metre) @ base
        mpis.append(MPIPlan(name, vector(world), facing_axes(base, name), near * metre, extent, *size))
    return ScenePlan(tuple(mpis), None, 1.0 * metre, 5.0 * metre, "hand-made drive")


def room_plan(
    observations: Observations, size: tuple[int, int, int], cube_voxels: int, near: float, cube_half_size: float
) -> ScenePlan:
    """The paper's ScanNet arrangement: five MPIs around the cameras' centre and a cube (sec. IV).

    Args:
        observations: training cameras.
        size: planes of every MPI, and their texel rows and columns.
        cube_voxels: voxels along each side of the cube; 0 for none.
        near: depth of the first plane, scene units.
        cube_half_size: half the cube's side, scene units.
    """
    base = observations.mean_axes
    center = (observations.centers.min(0) + observations.centers.max(0)) / 2
    extent = (-OVERLAPPING, OVERLAPPING, -OVERLAPPING, OVERLAPPING)
    names = ("front", "back", "left", "right", "below")
    mpis = (MPIPlan(n, vector(center), facing_axes(base, n), near, extent, *size) for n in names)
    corners = vector(center - cube_half_size), vector(center + cube_half_size)
    cube = CubePlan(*corners, (cube_voxels, cube_voxels, cube_voxels)) if cube_voxels else None
    return ScenePlan(tuple(mpis), cube, 0.1 * near, near, "hand-made room")
