"""Tables and fields of which some tiles hold nothing."""

from __future__ import annotations

import numpy as np
import torch
from hand_made import make_mpi, random_mpi
from random_fields import fill

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.bricks import new_table
from mmpi_ns.scene.geometry import Frames
from mmpi_ns.scene.plan import CubePlan, ScenePlan
from mmpi_ns.scene.texels import BRICK, make_grids, number_tiles

SHAPES = [(3, 8, 8), (2, 9, 16), (4, 7, 31), (1, 24, 2), (3, 19, 21)]


def layout_of(shapes, tiles=None):
    """A scene of nothing but texels."""
    return SceneLayout((), Frames.pack(()), make_grids(shapes, tiles), [torch.zeros(0)])


def chance(count, share, seed=0):
    return torch.rand(count, generator=torch.Generator().manual_seed(seed)) < share


def thinned(shapes, share=0.6, seed=0):
    """Grids of which some tiles hold nothing, their bricks in no order, and a table with its dense blocks."""
    count = len(make_grids(shapes)[0].tiles)
    tiles = number_tiles(chance(count, share, seed))
    order = torch.randperm(int(tiles.max()), generator=torch.Generator().manual_seed(seed)) + 1
    tiles = torch.where(tiles > 0, order[(tiles - 1).clamp(min=0).long()], 0).to(torch.int32)
    grids = make_grids(shapes, tiles)
    table = new_table(tiles, 2, empty=-20.0, dtype=torch.float64)
    rng = np.random.default_rng(seed)
    table[BRICK:] = torch.tensor(rng.normal(size=(len(table) - BRICK, 2)))
    blocks = []
    for g in grids:
        block = np.full((g.depth, g.height, g.width, 2), -20.0)
        for z, y, x in np.ndindex(*block.shape[:3]):
            brick = int(tiles[g.first_tile + (z * -(-g.height // 8) + y // 8) * -(-g.width // 8) + x // 8])
            block[z, y, x] = table[brick * 64 + y % 8 * 8 + x % 8].numpy()
        blocks.append(block)
    return grids, table, blocks


def big_plan(seed=0, with_cube=True):
    rng = np.random.default_rng(seed)
    mpis = [random_mpi(rng, str(k), planes=10) for k in range(3)]
    sizes = [(19, 21), (16, 24), (9, 33)]
    mpis = tuple(make_mpi(m.name, m.origin, m.axes, m.near, m.extent, planes=10, height=h, width=w)
                 for m, (h, w) in zip(mpis, sizes, strict=True))  # fmt: skip
    cube = CubePlan((-1.5, -1.2, -1.0), (1.4, 1.6, 2.0), (6, 17, 12)) if with_cube else None
    return ScenePlan(mpis, cube, 0.05, 1.0)


def bricked_field(share=0.6, seed=0, **filled):
    """A field with random tables of which some tiles hold nothing."""
    field = MMPIField(big_plan(seed), feature_channels=5, hidden_width=6, samples_per_voxel=1.5)
    fill(field, seed, **filled)
    for table in (field.features, field.reliability, field.touched):
        table.data[:BRICK] = 0
    field._keep(chance(field.num_bricks + 1, share, seed))
    return field
