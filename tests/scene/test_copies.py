"""Finer copies of MPIs: which tiles they hold, what their texels are, how rays see them, and the gain that chooses."""

from __future__ import annotations

import numpy as np
import torch
from bricked import big_plan, bricked_field, chance
from random_fields import bundle, compare, random_rays, render

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.tables import RELEASED_DENSITY
from mmpi_ns.scene.bricks import tiles_with_copies
from mmpi_ns.scene.texels import BRICK


def some_tiles(field, share, seed=1):
    """Tiles of a part of the stored bricks of MPIs."""
    mpis, tiles = len(field.plan.mpis), field.grids
    voxels = tiles[mpis].first_tile if len(tiles) > mpis else len(field.tiles)
    return (field.tiles > 0) & chance(len(field.tiles), share, seed) & (torch.arange(len(field.tiles)) < voxels)


def test_copies_hold_the_chosen_tiles_and_mpis_what_is_chosen_beside_others():
    """By loops over tiles."""
    field = bricked_field(0.8)
    chosen = some_tiles(field, 0.7)
    fine, kept = tiles_with_copies(field.grids, field.copy_grids(), chosen)
    for grid, copy in zip(field.grids, field.copy_grids(), strict=False):
        parts = [x[grid.first_tile :][: grid.own_tiles.numel()].view(grid.own_tiles.shape) for x in (chosen, kept)]
        (taken, remains), stored = (x.numpy() for x in parts), grid.own_tiles.numpy() > 0
        for z, y, x in np.ndindex(copy.own_tiles.shape):
            tile = copy.first_tile + (z * copy.down + y) * copy.across + x
            assert bool(fine[tile]) == taken[z, y // 2, x // 2]
        for z, y, x in np.ndindex(grid.own_tiles.shape):
            around = np.s_[z, max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
            alone = taken[around][stored[around]].all()
            assert remains[z, y, x] == (stored[z, y, x] and not (taken[z, y, x] and alone))
    cube = field.grids[-1]
    assert torch.equal(kept[cube.first_tile :], field.tiles[cube.first_tile :] > 0)
    assert 0 < kept.sum() < (field.tiles > 0).sum()


def test_texels_of_a_copy_lie_on_those_of_its_mpi_and_between_them():
    field = bricked_field(0.8)
    old, before = field.grids, field.features.data.clone()
    field.copy_finely(some_tiles(field, 0.5))
    compared = 0
    for mpi, copy in zip(old[:3], field.grids, strict=False):
        for z, y, x in [*np.ndindex(copy.depth, copy.height, copy.width)][::7]:
            row = int(copy.row(*(torch.tensor(i) for i in (z, y, x))))
            corners = [(z, j, i) for j in {y // 2, (y + 1) // 2} for i in {x // 2, (x + 1) // 2}]
            rows = [int(mpi.row(*(torch.tensor(i) for i in corner))) for corner in corners]
            if row < BRICK or min(rows) < BRICK:
                continue
            mean = sum(before[r].double() for r in rows) / len(rows)
            assert torch.allclose(field.features.data[row].double(), mean, atol=1e-6)
            compared += 1
    assert compared > 100
    assert not field.features.data[:BRICK].any() and (field.density.data[:BRICK] == RELEASED_DENSITY).all()


def test_copies_of_everything_change_no_image():
    field = bricked_field(share=1.0)
    rays = bundle(*random_rays(field.plan, 300, seed=3))
    before, heads = render(field, rays), field.plan.num_heads
    field.copy_finely(some_tiles(field, 1.0))
    after = render(field, rays)
    assert field.plan.num_heads == heads + 3 and all((g.own_tiles == 0).all() for g in field.grids[3:6])
    assert (after.rgb - before.rgb).abs().max() < 1e-4 and before.rgb.std() > 0.05
    assert torch.equal(field.planned_heads(torch.arange(7)), torch.tensor([0, 1, 2, 0, 1, 2, 3]))


def test_rays_through_copies_look_as_the_oracle_says(form):
    field = bricked_field()
    field.copy_finely(some_tiles(field, 0.5))
    assert compare(field, *random_rays(field.plan, 12, seed=5), blends=False) >= 8


def test_a_state_with_copies_comes_back():
    written, read = bricked_field(), MMPIField(big_plan(4), feature_channels=5, hidden_width=6)
    written.copy_finely(some_tiles(written, 0.5))
    read.load_state_dict(written.state_dict())
    assert read.copied and read.plan == written.plan and read.full_plan == written.full_plan
    for name, values in written.state_dict().items():
        assert torch.equal(values, read.state_dict()[name]), name
