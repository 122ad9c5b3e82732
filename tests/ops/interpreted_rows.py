"""Tables and colours as on a GPU, by Triton kernels or plain torch: run like interpreted_march.py."""

from __future__ import annotations

import pytest
import torch
from bricked import SHAPES, bricked_field, layout_of, thinned
from gather_batches import batch, in_float32, with_gradients
from interpreting import interpreted, normal  # noqa: F401
from random_scenes import dense_grad

from mmpi_ns.ops import gather, interpolate
from mmpi_ns.ops.interpolate import Table
from mmpi_ns.ops.variation import total_variation

# Rows ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("channels", "taps"), [(1, 4), (9, 4), (9, 8)])
def test_interpolation_and_its_gradient_are_those_of_float64(channels, taps):
    g = torch.Generator().manual_seed(taps)
    rows, weights = torch.randint(0, 40, (300, taps), generator=g), torch.rand(300, taps, generator=g)
    table, exact = Table(normal(50, channels)), normal(50, channels).double().requires_grad_()
    upstream = normal(300, channels, seed=2)
    read = interpolate.interpolate(table, rows, weights)
    wanted = interpolate.interpolate_densely(exact, rows, weights.double())
    assert (read.double() - wanted).abs().max() < 2e-6
    (read * upstream).sum().backward()
    (wanted * upstream.double()).sum().backward()
    assert (dense_grad(table).double() - exact.grad).abs().max() < 2e-5
    assert exact.grad[40:].abs().max() == 0 < exact.grad.abs().max()


def test_gathered_rows_are_read_like_the_table_and_have_one_gradient_each():
    rows, weights = torch.randint(0, 50, (80, 4), generator=torch.Generator().manual_seed(1)), torch.rand(80, 4)
    index, some = interpolate.index_rows(rows, 50), torch.arange(0, 80, 3)
    table, plain = Table(normal(50, 9)), normal(50, 9).requires_grad_()
    values = interpolate.read_rows(table, index.unique)
    read = interpolate.weigh_rows(values, index.positions, weights)
    part = interpolate.weigh_rows(values, index.positions[some], weights[some])
    wanted = interpolate.interpolate_densely(plain, rows, weights)
    assert torch.allclose(read, wanted, atol=1e-6) and torch.allclose(part, wanted[some], atol=1e-6)
    ((read**2).sum() + 2 * part.sum()).backward()
    ((wanted**2).sum() + 2 * wanted[some].sum()).backward()
    assert torch.allclose(dense_grad(table), plain.grad, atol=1e-4)


@pytest.mark.parametrize("spread", ["side by side", "a brick apart", "anywhere", "one"])
@pytest.mark.parametrize("count", [1, 7, 1500])
def test_distinct_rows_are_those_of_the_reference(count, spread):
    g, different, most = torch.Generator().manual_seed(count), 1 + count // 3, 2**17  # several programs of words
    chosen = torch.randint(0, different, (count, 4), generator=g)
    anywhere = torch.randint(0, most, (different,), generator=g)
    anywhere[0] = most - 1
    rows = {"side by side": chosen, "a brick apart": chosen * 64, "anywhere": anywhere[chosen], "one": chosen * 0}[
        spread
    ]
    found = interpolate.index_rows(rows, most)
    assert torch.equal(found.unique, rows.unique())
    assert found.positions.shape == rows.shape and torch.equal(found.unique[found.positions.long()], rows)


def test_padded_rows_end_in_row_0_which_nothing_is_added_to():
    rows = torch.tensor([[7, 3], [3, 90], [7, 7]])
    found = interpolate.index_rows(rows, 100, pads=True)
    assert found.unique.tolist() == [3, 7, 90, 0, 0, 0] and torch.equal(found.unique[found.positions.long()], rows)
    table = Table(normal(100, 1))
    interpolate.interpolate(table, rows, torch.ones(3, 2)).sum().backward()
    assert torch.equal(dense_grad(table)[:, 0], torch.bincount(rows.reshape(-1), minlength=100).float())


@pytest.mark.parametrize("pads", [False, True])
def test_no_rows_are_no_distinct_rows(pads):
    found = interpolate.index_rows(torch.zeros(0, 4, dtype=torch.int64), 9, pads)
    assert found.unique.shape == (0,) and found.positions.shape == (0, 4)
    assert interpolate.sum_rows(found.positions, torch.zeros(0, 3), torch.zeros(0, 4), 0).shape == (0, 3)


def test_rows_gather_what_their_entries_give():
    rows = torch.randint(0, 40, (300, 4), generator=torch.Generator().manual_seed(1))
    values, weights = normal(300, 9), torch.rand(300, 4)
    index = interpolate.index_rows(rows, 50)
    found = torch.zeros(40, 9).index_copy_(
        0, index.unique, interpolate.sum_rows(index.positions, values, weights, len(index.unique))
    )
    each = values[:, None].double() * weights[..., None].double()
    wanted = torch.zeros(40, 9, dtype=torch.float64).index_add_(0, rows.reshape(-1), each.reshape(-1, 9))
    assert wanted.abs().max() > 1 and (found.double() - wanted).abs().max() < 1e-5


def test_texels_are_those_of_the_grids_also_at_borders_and_outside():
    field = bricked_field()
    g = torch.Generator().manual_seed(1)
    ndc = torch.rand(200, 3, generator=g) * 2.4 - 1.2
    ndc[:20] = ndc[:20].sign()
    heads, planes = torch.randint(0, 3, (200,), generator=g), torch.randint(0, 9, (200,), generator=g)
    rows, weights = interpolate.texel_rows(field.layout, heads, planes, ndc)
    for k in range(3):
        own = heads == k
        wanted_rows, wanted_weights = field.grids[k].bilinear(planes[own], ndc[own])
        assert torch.equal(rows[own], wanted_rows) and torch.allclose(weights[own], wanted_weights, atol=2e-6)


@pytest.mark.parametrize(("channels", "chroma"), [(1, 0.0), (9, 0.0), (3, 2.5), (9, 2.5)])
def test_variation_equals_the_reference_with_its_gradient(channels, chroma):
    grids, _, _ = thinned(SHAPES)
    layout = layout_of(SHAPES, grids[0].tiles)
    table = normal(len(grids[0].places) * 64, channels) * 2
    texels = torch.cat([g.rows[g.rows >= 64] for g in grids] + [torch.arange(5)])  # and some of the empty brick
    rows = texels[torch.randperm(len(texels), generator=torch.Generator().manual_seed(1))[:-9]]
    scales, found = torch.tensor([(0.5 + k, 2.0, 1.0) for k in range(len(grids))]), []
    for function, dtype in ((total_variation, torch.float32), (total_variation.reference, torch.float64)):
        values = table[rows].to(dtype).requires_grad_()
        value = function(values, table.to(dtype), rows, layout, scales, chroma)
        (3 * value).backward()
        found.append((value.item(), values.grad.double()))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5) and found[0][0] > 1
    assert torch.allclose(found[0][1], found[1][1], atol=1e-5)


# Colours -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("trains", "moved"), [(True, True), (True, False), (False, False)])
@pytest.mark.parametrize(("channels", "in_cube"), [(3, False), (9, True), (20, True)])
def test_gathered_sums_and_their_gradients_are_those_of_float64(channels, in_cube, trains, moved):
    given, upstream = batch(channels, rays=40, in_cube=in_cube), [normal(40, n) for n in (channels, 1, 3, 3)]
    if trains:
        found = with_gradients(gather.gather_taps, in_float32(given), upstream, moved)
        wanted = with_gradients(gather.gather_taps.reference, given, upstream, moved)
    else:
        values, groups, slots, weights, wanted_rays = in_float32(given)
        sums = gather.gather_taps(values, groups, slots, weights.requires_grad_(), wanted_rays)
        (sums.gathered * upstream[0]).sum().backward()
        found = [weights.grad.double()]
        wanted = with_gradients(gather.gather_taps.reference, given, [upstream[0], *(0 * u for u in upstream[1:])])[-1:]
    for a, b in zip(found, wanted, strict=True):
        assert b.abs().max() > 0.05 and (a - b).abs().max() < 3e-6 * (1 + b.abs().max())


def test_without_samples_rays_gather_nothing():
    weights = torch.zeros(3, 2, requires_grad=True)
    sums = gather.gather_taps(
        torch.zeros(0, 9), [], torch.zeros(0, dtype=torch.int64), weights, torch.ones(3, dtype=torch.bool)
    )
    assert all(s.shape[0] == 3 and not s.any() for s in vars(sums).values())
    sums.gathered.sum().backward()
    assert not weights.grad.any()
