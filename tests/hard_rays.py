"""Rays that are hard to march, through a scene in which every distance is a tie."""

from __future__ import annotations

import numpy as np
from hand_made import make_mpi, unit
from random_fields import bundle

from mmpi_ns.scene.plan import CubePlan, ScenePlan


def hard_plan():
    """Two MPIs that coincide, one that ends, and a cube."""
    twin = make_mpi("twin", planes=12)
    cube = CubePlan((-1.0, -1.0, 2.0), (1.0, 1.0, 4.0), (4, 4, 4))
    return ScenePlan((make_mpi(planes=12), twin, make_mpi("ends", near=0.5, far=3.0, planes=5)), cube, 0.05, 1.0)


HARD_RAYS = {
    "along the planes": ([0, 0, 1.5], [1, 0, 0]),
    "nearly along the planes": ([0, 0, 2], [1, 0, 2e-6]),
    "from a plane": ([0.1, 0.1, 1.0], [0, 0, 1]),
    "from behind all finite planes": ([0, 0, 500.0], [0.1, 0, 1]),
    "backwards": ([0, 0, 5], [0, 0, -1]),
    "on the border of the frustum": ([0, 0, 0], [1, 0.5, 1]),
    "on the axis": ([0, 0, 0], [0, 0, 1]),
    "into a corner of the cube": ([0, 0, 0], [0.5, 0.5, 2.0]),
    "from inside the cube": ([0.2, 0.1, 3.0], [0.3, 0.2, 1.0]),
    "from far away": ([0, 0, -1e5], [0, 0, 1]),
}


def hard_rays():
    """All of them, as a bundle."""
    origins, directions = (np.array(x, float) for x in zip(*HARD_RAYS.values(), strict=True))
    return bundle(origins, np.stack([unit(d) for d in directions]))
