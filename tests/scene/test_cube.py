"""The centred cube: which samples of a ray lie inside it (geometry.py)."""

from __future__ import annotations

import math

import pytest
import torch
from hand_made import rays

from mmpi_ns.scene.geometry import Cube, cube_hits
from mmpi_ns.scene.plan import CubePlan

F64 = torch.float64

BOX = CubePlan((-1.0, -2.0, -1.0), (1.0, 2.0, 3.0), (9, 9, 5))


def test_cube_step_is_the_shortest_voxel_side_over_the_samples_per_voxel():
    # Voxel sides: x 2/4, y 4/8, z 4/8.
    assert Cube.pack(BOX, 1.0).step == 0.5
    assert Cube.pack(CubePlan((0.0, 0.0, 0.0), (1.0, 2.0, 4.0), (3, 3, 3)), 2.0).step == 0.25
    corners = Cube.pack(BOX, 1.0, dtype=F64).normalised(
        torch.tensor([BOX.lower, BOX.upper, (0.0, 0.0, 1.0)], dtype=F64)
    )
    assert corners.tolist() == [[-1] * 3, [1] * 3, [0] * 3]


@pytest.mark.parametrize(
    ("origin", "direction", "near", "far", "expected"),
    [
        ([0, 0, 0], [1, 0, 0], 0, math.inf, [0, 1]),  # from inside: t = 0.25, 0.75
        ([-3, 0, 0], [1, 0, 0], 0, math.inf, [4, 5, 6, 7]),
        ([-3, 0, 0], [1, 0, 0], 2.3, 3.3, [5, 6]),
        ([-3, 0, 0], [-1, 0, 0], 0, math.inf, []),  # behind
        ([-3, 2.5, 0], [1, 0, 0], 0, math.inf, []),  # parallel, outside the slab
        ([-3, 2.0, 0], [1, 0, 0], 0, math.inf, [4, 5, 6, 7]),  # parallel, on the slab
        ([-3, 0, 0], [0, 1, 0], 0, math.inf, []),
    ],
)
def test_cube_hits_of_hand_made_rays(origin, direction, near, far, expected):
    first, count = cube_hits(*rays(origin, direction, near, far), Cube.pack(BOX, 1.0, dtype=F64))
    assert [int(first) + i for i in range(int(count))] == expected
