"""Which texels a lookup reads (texels.py), against lookups by loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mmpi_ns.ops.interpolate import interpolate_densely
from mmpi_ns.scene.bricks import resample
from mmpi_ns.scene.texels import BRICK, head_grids

F64 = torch.float64


@pytest.fixture
def table(plan):
    return torch.tensor(np.random.default_rng(0).normal(size=(len(head_grids(plan)[0].places) * BRICK, 3)), dtype=F64)


def block(table, grid):
    return table[grid.rows].view(grid.depth, grid.height, grid.width, -1).numpy()


def positions(count, dims):
    """Random coordinates, a few of them outside [-1, 1], on corners and on texel centres."""
    rng = np.random.default_rng(dims)
    coordinates = rng.uniform(-1.3, 1.3, size=(count, dims))
    coordinates[:9] = rng.choice([-1.0, 0.0, 1.0], size=(9, dims))
    return torch.tensor(coordinates, dtype=F64)


def test_heads_own_consecutive_tiles_with_the_cube_last_and_every_texel_a_row(plan):
    grids = head_grids(plan.scaled(9))
    sizes = [(g.first_tile, g.depth, g.height, g.width, g.down, g.across) for g in grids]
    assert sizes == [(0, 9, 15, 21, 2, 3), (54, 9, 15, 21, 2, 3), (108, 15, 10, 10, 2, 2)]
    rows = torch.cat([g.rows for g in grids])
    assert len(rows.unique()) == len(rows) == plan.scaled(9).texels and rows.min() >= BRICK
    assert rows.max() < len(grids[0].places) * BRICK == (108 + 60 + 1) * BRICK


def test_nearest_texel_is_the_one_with_the_largest_weight(plan):
    ndc = positions(300, 3)
    for grid in head_grids(plan):
        rows, weights = grid.trilinear(ndc)
        clear = weights.amax(-1) > 0.13  # ties on cell midpoints may go either way
        best = rows.gather(-1, weights.argmax(-1, keepdim=True))[:, 0]
        assert torch.equal(grid.nearest(ndc)[clear], best[clear]) and clear.sum() > 250


def test_gradient_of_a_lookup_goes_to_the_texels_it_read(plan, table):
    grid = head_grids(plan)[1]
    rows, weights = grid.bilinear(torch.tensor([4]), torch.tensor([[0.1, 0.3]], dtype=F64))
    table.requires_grad_()
    interpolate_densely(table, rows, weights)[0, 1].backward()
    assert set(table.grad[:, 1].nonzero()[:, 0].tolist()) == set(rows[0].tolist())
    assert table.grad[:, 1].sum().item() == pytest.approx(1) and table.grad[:, 0].abs().sum() == 0


def test_resampling_keeps_what_is_linear_and_lookups_of_it(plan):
    """A table that is linear over each grid reads the same at every resolution, in every head."""

    def linear(grids):
        table = torch.zeros(len(grids[0].places) * BRICK, 2, dtype=F64)
        for g in grids:
            z, y, x = torch.meshgrid(
                torch.arange(g.depth, dtype=F64),
                torch.linspace(-1, 1, g.height, dtype=F64),
                torch.linspace(-1, 1, g.width, dtype=F64),
                indexing="ij",
            )
            table[g.rows] = torch.stack([3 * x - y, 0.5 * y + (z if g.depth == 9 else 0 * z)], -1).view(-1, 2)
        return table

    old, new = head_grids(plan), head_grids(plan.scaled(4))
    resampled = resample(linear(old), old, new)
    assert [g.width for g in new] == [14, 14, 8]
    assert resampled.shape == linear(new).shape
    assert all(torch.allclose(resampled[g.rows], linear(new)[g.rows], atol=1e-12) for g in new)


def test_resampling_keeps_planes_apart_and_corners_exact(plan, table):
    old, new = head_grids(plan), head_grids(plan.scaled(2))
    resampled = resample(table, old, new)
    for a, b in zip(old, new, strict=True):
        before, after = block(table, a), block(resampled, b)
        assert np.array_equal(after[0, 0, 0], before[0, 0, 0]) and np.array_equal(after[-1, -1, -1], before[-1, -1, -1])
    lonely = torch.zeros(len(table), 1, dtype=F64)
    lonely[old[0].rows[4 * 35 : 5 * 35]] = 1
    spread = block(resample(lonely, old, new), new[0])
    assert (spread[4] == 1).all() and spread.sum() == spread[4].size
