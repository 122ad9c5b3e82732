"""Which texels a lookup reads (texels.py), against lookups by loops."""

from __future__ import annotations

import numpy as np
import oracle
import pytest
import torch

from mmpi_ns.ops.interpolate import interpolate_densely
from mmpi_ns.scene.bricks import resample
from mmpi_ns.scene.texels import BRICK, head_grids, make_grids

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


def test_bilinear_lookup_equals_the_loop_on_every_plane_of_every_mpi(plan, table):
    uv = positions(90, 2)
    plane = torch.arange(90) % 9
    for grid in head_grids(plan)[:-1]:
        rows, weights = grid.bilinear(plane, uv)
        found = interpolate_densely(table, rows, weights)
        for i in range(90):
            wanted = oracle.bilinear(block(table, grid)[i % 9], float(uv[i, 0]), float(uv[i, 1]))
            assert np.allclose(found[i], wanted, rtol=1e-12, atol=1e-12)


def test_trilinear_lookup_equals_the_loop_in_every_head(plan, table):
    ndc = positions(90, 3)
    for grid in head_grids(plan):
        found = interpolate_densely(table, *grid.trilinear(ndc))
        for i in range(90):
            wanted = oracle.trilinear(block(table, grid), ndc[i].tolist())
            assert np.allclose(found[i], wanted, rtol=1e-12, atol=1e-12)


def test_corners_of_the_frustum_are_texel_centres(plan, table):
    grid = head_grids(plan)[1]
    values = block(table, grid)
    corners = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]], dtype=F64)
    found = interpolate_densely(table, *grid.bilinear(torch.full((4,), 8), corners))
    wanted = [values[8, 0, 0], values[8, 0, -1], values[8, -1, 0], values[8, -1, -1]]
    assert np.array_equal(found, np.array(wanted))


def test_trilinear_on_a_plane_equals_bilinear_on_that_plane(plan, table):
    """Near plane s = -1, plane at infinity s = +1, even spacing between: the order in which planes are stored."""
    grid, uv = head_grids(plan)[0], positions(45, 2)
    for plane in range(9):
        s = torch.full((45, 1), 2 * plane / 8 - 1, dtype=F64)
        flat = interpolate_densely(table, *grid.bilinear(torch.full((45,), plane), uv))
        assert torch.allclose(flat, interpolate_densely(table, *grid.trilinear(torch.cat([uv, s], -1))))


def test_lookups_stay_in_their_own_block_and_weights_sum_to_one(plan):
    ndc = torch.cat([positions(200, 3), torch.full((1, 3), 1e30), torch.full((1, 3), -1e30)])
    for grid in head_grids(plan):
        lookups = [grid.trilinear(ndc), (grid.nearest(ndc)[:, None], torch.ones(202, 1))]
        lookups += [grid.bilinear(torch.tensor(p).expand(202), ndc[:, :2]) for p in (0, grid.depth - 1)]
        for rows, weights in lookups:
            assert torch.isin(rows, grid.rows).all() and grid.holds(rows.reshape(-1)).all()
            assert torch.allclose(weights.double().sum(-1), torch.ones(202, dtype=F64)) and (weights >= 0).all()


@pytest.mark.parametrize("size", [270, 4096])
def test_float32_lookups_are_off_by_a_small_share_of_a_texel(size):
    (grid,) = make_grids([(2, size, size)])
    uv = positions(2000, 2).clamp(-1, 1)
    for i, dtype in ((0, F64), (1, torch.float32)):
        rows, weights = grid.bilinear(torch.zeros(2000, dtype=torch.int64), uv.to(dtype))
        column = (grid.texel(rows)[2] * weights.double()).sum(-1)
        if i == 0:
            exact = column
    # A coordinate in [-1, 1] rounds to 6e-8, which is size / 2 times that in texels.
    assert (column - exact).abs().max() < 2.0e-7 * size


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


def test_resampling_to_the_same_size_changes_nothing(plan, table):
    grids = head_grids(plan)
    found = resample(table, grids, grids)
    assert all(torch.equal(found[g.rows], table[g.rows]) for g in grids)
