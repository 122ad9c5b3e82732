"""Tables of bricks: the same arithmetic as dense tables, an empty brick that never changes, growth and release."""

from __future__ import annotations

import numpy as np
import oracle
import pytest
import torch
from bricked import SHAPES, big_plan, bricked_field, chance, layout_of, thinned
from random_fields import bundle, compare, random_rays, render, sampled
from random_scenes import of_rays

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.tables import RELEASED_DENSITY, TABLES
from mmpi_ns.ops.interpolate import interpolate_densely
from mmpi_ns.ops.variation import total_variation
from mmpi_ns.scene.bricks import (
    grown_tiles,
    new_table,
    resample,
)
from mmpi_ns.scene.texels import BRICK, make_grids, number_tiles
from mmpi_ns.training.touched_adam import TouchedAdam

# Rows ----------------------------------------------------------------------------------------------------------------


def test_lookups_read_what_dense_tables_would_give():
    grids, table, blocks = thinned(SHAPES[:3] + SHAPES[4:])
    rng = np.random.default_rng(1)
    ndc = torch.tensor(rng.uniform(-1.3, 1.3, size=(150, 3)))
    ndc[:9] = torch.tensor(rng.choice([-1.0, 0.0, 1.0], size=(9, 3)))
    for grid, block in zip(grids, blocks, strict=True):
        planes = torch.arange(150) % grid.depth
        flat = interpolate_densely(table, *grid.bilinear(planes, ndc))
        solid = interpolate_densely(table, *grid.trilinear(ndc))
        assert (flat < -1).any() and (flat > -1).any()
        for i in range(150):
            assert np.allclose(flat[i], oracle.lookup(block[i % grid.depth], ndc[i, :2]), atol=1e-12)
            assert np.allclose(solid[i], oracle.lookup(block, ndc[i]), atol=1e-12)
        z, y, x = (((ndc[:, a] + 1) / 2 * (n - 1)).round().clamp(0, n - 1).long().numpy()
                   for a, n in ((2, grid.depth), (1, grid.height), (0, grid.width)))  # fmt: skip
        assert np.array_equal(table[grid.nearest(ndc)], block[z, y, x])


# Rays ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blends", [True, False])
def test_rays_through_released_bricks_look_as_the_oracle_says(form, blends):
    field = bricked_field()
    assert compare(field, *random_rays(field.plan, 12, seed=5), blends) >= 8


@pytest.mark.parametrize("order", ["rising", "anyhow"])
@pytest.mark.parametrize("channels", [1, 5, 9, 21])
def test_variation_beside_released_bricks_equals_float64(channels, order):
    grids, _, _ = thinned(SHAPES)
    layout = layout_of(SHAPES, grids[0].tiles)
    rows = torch.cat([grid.rows[grid.rows >= BRICK] for grid in grids] + [torch.arange(3)])
    mixed = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(3))]
    rows = rows.sort()[0] if order == "rising" else mixed
    table = torch.randn(len(grids[0].places) * BRICK, channels, generator=torch.Generator().manual_seed(0)) * 2
    scales, actual = torch.tensor([(0.5 + k, 2.0, 1.0) for k in range(len(grids))]), []
    for function, dtype in ((total_variation, torch.float32), (total_variation.reference, torch.float64)):
        values = table[rows].to(dtype).requires_grad_()
        value = function(values, table.to(dtype), rows, layout, scales)
        value.backward()
        actual.append((value.item(), values.grad.double()))
    assert actual[0][0] == pytest.approx(actual[1][0], rel=1e-6) and actual[0][0] > 1
    assert torch.allclose(actual[0][1], actual[1][1], atol=2e-6) and not actual[0][1][rows < BRICK].any()
    assert (actual[1][1] != 0).float().mean() > 0.9


# The empty brick -----------------------------------------------------------------------------------------------------


def train(field, steps=4, blends=False):
    """Steps of everything that learns, with moments, on rays that read bricks and what lies beside them."""
    tables = [getattr(field, name) for name in TABLES]
    optimizer = TouchedAdam([*tables, field.networks.weights], lr=0.1)
    field.train()
    read = 0
    for step in range(steps):
        rays = bundle(*random_rays(field.plan, 60, seed=step))
        samples = sampled(field, rays)
        tau, lookup = field.optical_depths(*samples)
        read += int((lookup.rows[lookup.taps.positions] < BRICK).sum())
        rgb = field.sample_colors(*samples, lookup)
        loss = (rgb * torch.tanh(tau)[:, None]).sum() + field.total_variation(lookup, 1.0, 1.0)
        loss = loss + field.sample_shares(*samples)[0].square().sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return optimizer, read


def test_the_empty_brick_never_changes(form):
    field = bricked_field()
    before = {name: getattr(field, name).detach().clone() for name in TABLES}
    optimizer, read = train(field)
    assert read > 1000, "rays do read it"
    for name, empty in zip(TABLES, (RELEASED_DENSITY, 0.0, 0.0), strict=True):
        table = getattr(field, name)
        assert (table[:BRICK] == empty).all() and not torch.equal(table, before[name])
        assert not optimizer.state[table]["moments"][:BRICK].any()
    assert not field.touched[:BRICK].any() and field.touched.any()


# Growth --------------------------------------------------------------------------------------------------------------


def test_growth_equals_dense_growth_where_everything_around_is_stored_and_goes_on_from_there():
    shapes, wider = [(3, 16, 21), (2, 24, 30), (4, 9, 17)], [(3, 23, 30), (2, 34, 42), (6, 13, 24)]
    is_cube = [False, False, True]
    full = make_grids(shapes, None, True)
    dense = new_table(full[0].tiles, 2, dtype=torch.float64).normal_(generator=torch.Generator().manual_seed(0))
    keep = chance(len(full[0].places), 0.7)
    keep[0] = True
    tiles, kept = number_tiles(keep[1:]), keep.nonzero()[:, 0]
    some, thin = make_grids(shapes, tiles, True), dense.view(-1, BRICK, 2)[kept].reshape(-1, 2)
    thin[:BRICK] = -20.0
    wide = make_grids(wider, None, True)
    reached = grown_tiles(some, wide, None)
    bricks = make_grids(wider, reached, True)
    actual, wanted = resample(thin, some, bricks, -20.0), resample(dense, full, wide)
    flat = torch.full_like(thin, 3.0)
    flat[:BRICK] = -20.0
    flat = resample(flat, some, bricks, -20.0)
    exact = 0
    for k, (a, b) in enumerate(zip(bricks, wide, strict=True)):
        stored = (some[k].rows >= BRICK).float().view(*shapes[k], 1)
        mode = {"size": wider[k], "mode": "trilinear"} if is_cube[k] else {"size": wider[k][1:], "mode": "bilinear"}
        axes = (3, 0, 1, 2) if is_cube[k] else (0, 3, 1, 2)
        images = stored.permute(*axes)[None] if is_cube[k] else stored.permute(*axes)
        there = torch.nn.functional.interpolate(images, align_corners=True, **mode).reshape(-1)
        rows = a.rows
        assert (rows[there > 1e-6] >= BRICK).all(), "whatever has a stored source is stored"
        alike = (there > 1 - 1e-6) & (rows >= BRICK)
        assert torch.allclose(actual[rows[alike]], wanted[b.rows[alike]], atol=1e-12)
        partly = (there > 1e-6) & ~alike
        assert actual[rows[partly]].abs().max() <= dense.abs().max() + 1e-9, "no texel mixes with the empty brick"
        assert torch.allclose(flat[rows[there > 1e-6]], torch.tensor(3.0, dtype=torch.float64), atol=1e-9)
        assert (actual[rows[(there == 0) & (rows >= BRICK)]] == -20).all()
        exact += int(alike.sum())
        assert partly.any() and (rows < BRICK).any()
    assert exact > 500


@pytest.mark.parametrize("wider", [(47, 61), (48, 64), (24, 31)])
def test_a_tile_is_stored_where_half_of_a_texel_comes_from_stored_ones(wider):
    """By loops over texels, in float64."""
    old = make_grids([(3, 24, 31)], number_tiles(chance(3 * 3 * 4, 0.4)))
    new = make_grids([(3, *wider)])
    stored = (old[0].rows >= BRICK).double().view(3, 24, 31).numpy()
    wanted = np.zeros(new[0].own_tiles.shape, bool)
    for z, y, x in np.ndindex(3, *wider):
        v, u = y * 23 / (wider[0] - 1), x * 30 / (wider[1] - 1)
        below, right = min(int(v), 22), min(int(u), 29)
        (a, b), (c, d) = stored[z, below : below + 2, right : right + 2]
        fy, fx = v - below, u - right
        share = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
        wanted[z, y // 8, x // 8] |= share > 0.4999
    kept = grown_tiles(old, new, None, 0.4999).view(wanted.shape) > 0
    assert np.array_equal(kept.numpy(), wanted)
    assert wanted.sum() < (grown_tiles(old, new, None) > 0).sum() or wider == (24, 31)


def test_growth_stores_only_what_training_rays_reach():
    old, new = make_grids([(2, 16, 16)]), make_grids([(2, 32, 32)])
    reachable = chance(32, 0.5)
    assert torch.equal(grown_tiles(old, new, reachable) > 0, reachable)


# Release -------------------------------------------------------------------------------------------------------------


def used(field, rays, least):
    """Notes what rays see, and releases."""
    field.look_afresh()
    _, samples = sampled(field, rays)
    _, lookup = field.optical_depths(rays, samples)
    weights = render(field, rays).composite.weights
    field.note_use(lookup, samples, weights, weights.new_ones(len(rays)))
    return of_rays(render(field, rays), weights), field.release_unused(least)


def test_a_release_changes_images_by_no_more_than_what_it_gives_up():
    field = bricked_field(share=1.0, log_depths=(-4, 1))
    rays = bundle(*random_rays(field.plan, 900, seed=3))
    before, bricks = render(field, rays), field.num_bricks
    weights, kept = used(field, rays, least := 0.02)
    assert kept is not None and 0.1 * bricks < field.num_bricks < 0.9 * bricks
    after = render(field, rays)
    assert torch.equal(before.samples.num_intersected, after.samples.num_intersected)
    # Only samples that weigh less than the bound get thinner, so what they weighed is all that others can gain.
    given_up = torch.stack([w[w < least].sum() for w in weights])
    change = (after.rgb - before.rgb).abs().amax(-1)
    assert (change <= 2 * given_up + 1e-5).all() and change.max() > 1e-4
    heavy = before.composite.weights >= least
    assert (after.composite.weights[heavy] >= before.composite.weights[heavy] - 1e-5).all()


def test_moments_and_marks_follow_their_texels():
    field = bricked_field()
    optimizer, _ = train(field)
    field.touched[BRICK:] = chance(len(field.touched) - BRICK, 0.5).to(torch.uint8)
    tables = {name: getattr(field, name) for name in TABLES}
    grids, count = field.grids, field.num_bricks

    def by_texel(grids, table):
        return torch.cat([table.detach()[grid.rows] for grid in grids])

    states = [optimizer.state[t]["moments"] for t in tables.values()]
    before = [by_texel(grids, t) for t in (*tables.values(), *states, field.touched)]
    field.peak = torch.rand(count + 1, generator=torch.Generator().manual_seed(0))
    field.crossings.fill_(1e9)
    old_rows = torch.cat([g.rows for g in grids])
    stays = field.peak[old_rows // BRICK] >= 0.5
    kept = field.release_unused(0.5)
    for table in tables.values():
        optimizer.keep_bricks(table, kept)
    states = [optimizer.state[t]["moments"] for t in tables.values()]
    after = [by_texel(field.grids, t) for t in (*tables.values(), *states, field.touched)]
    assert 0 < field.num_bricks < count and all(tables[n] is getattr(field, n) for n in TABLES)
    for a, b in zip(before, after, strict=True):
        assert torch.equal(a[stays & (old_rows >= BRICK)], b[stays & (old_rows >= BRICK)])
    rows = torch.cat([g.rows for g in field.grids])
    assert (rows[~stays] < BRICK).all() and (rows[stays & (old_rows >= BRICK)] >= BRICK).all()
    train(field, steps=1)  # and goes on


def test_bricks_without_a_trained_texel_go_before_blending_and_change_nothing():
    field = bricked_field()
    field.touched[torch.cat([g.rows for g in field.grids[1:2]])] = 0
    field.reliability.data[field.touched == 0] = 0  # never trained: as it started
    rays = bundle(*random_rays(field.plan, 40, seed=2))
    field.density.data[field.touched == 0] = RELEASED_DENSITY
    before, count = render(field, rays, blends=True), field.num_bricks
    assert field.release_untouched() is not None and field.num_bricks < count
    after = render(field, rays, blends=True)
    assert (field.grids[1].rows < BRICK).all()
    assert (after.composite.weights - before.composite.weights).abs().max() < 1e-6
    assert (after.rgb - before.rgb).abs().max() < 1e-6


# State ---------------------------------------------------------------------------------------------------------------


def test_a_state_dict_holds_the_stored_bricks_alone_and_comes_back_as_it_was():
    written, read = bricked_field(0.3), MMPIField(big_plan(4), feature_channels=5, hidden_width=6)
    written.peak.uniform_()
    state = written.state_dict()
    assert len(state["density"]) == BRICK * (written.num_bricks + 1) < 0.4 * BRICK * len(state["tiles"])
    read.samples_per_voxel = written.samples_per_voxel
    read.load_state_dict(state)
    for name, value in state.items():
        assert torch.equal(read.state_dict()[name], value), name
    read.tiles[0] += 1
    assert not torch.equal(read.tiles, state["tiles"]), "nothing is shared with what was read"
    read.tiles[0] -= 1
    rays = bundle(*random_rays(written.plan, 20, seed=3))
    assert torch.equal(render(read.eval(), rays).rgb, render(written.eval(), rays).rgb)
