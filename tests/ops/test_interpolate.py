"""Weighted sums of table rows: the fast path equals the plain one, and rows that were read have a gradient
(ops/interpolate)."""

from __future__ import annotations

import pytest
import torch
from bricked import bricked_field
from compiled import both, compiled, normal  # noqa: F401
from random_fields import random_field
from random_scenes import dense_grad

from mmpi_ns.ops.interpolate import (
    Table,
    index_rows,
    interpolate,
    interpolate_densely,
    read_rows,
    sum_rows,
    texel_rows,
    weigh_rows,
)

F64 = torch.float64


def lookup(samples=50, corners=4, rows=30, channels=5, dtype=F64, seed=0):
    g = torch.Generator().manual_seed(seed)
    return (
        torch.randn(rows, channels, generator=g, dtype=F64).to(dtype),
        torch.randint(0, rows, (samples, corners), generator=g),
        torch.rand(samples, corners, generator=g, dtype=F64).to(dtype),
    )


def test_interpolation_by_hand():
    table = torch.tensor([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]])
    rows, weights = torch.tensor([[0, 2], [1, 1]]), torch.tensor([[0.25, 0.75], [0.5, 0.5]])
    for function in (interpolate_densely, interpolate):
        assert function(table, rows, weights).tolist() == [[3.25, 32.5], [2.0, 20.0]]


@pytest.mark.parametrize("channels", [1, 3, 9])
@pytest.mark.parametrize("corners", [1, 4, 8])
@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 2e-6), (F64, 1e-14)])
def test_fast_path_equals_the_reference_with_its_gradient(channels, corners, dtype, error):
    values, rows, weights = lookup(channels=channels, corners=corners, dtype=dtype)
    table, plain = Table(values.clone()), values.clone().requires_grad_()
    out, exact = interpolate(table, rows, weights), interpolate_densely(plain, rows, weights)
    assert out.shape == (50, channels) and torch.allclose(out, exact, atol=error, rtol=error)
    upstream = torch.randn(50, channels, generator=torch.Generator().manual_seed(1), dtype=F64).to(dtype)
    out.backward(upstream)
    exact.backward(upstream)
    assert torch.equal(table.grad_rows, rows.unique()) and table.grad.shape == (len(rows.unique()), channels)
    assert torch.allclose(dense_grad(table), plain.grad, atol=10 * error, rtol=10 * error)


def test_gradients_of_rows_and_weights_are_finite_differences():
    values, rows, weights = lookup(samples=6, rows=7, channels=2)
    inputs = (values.requires_grad_(), weights.requires_grad_())
    assert torch.autograd.gradcheck(lambda v, w: weigh_rows(v, rows, w).sin(), inputs)


def test_no_samples_give_no_values_and_no_gradient():
    table = Table(torch.randn(5, 3))
    out = interpolate(table, torch.zeros(0, 4, dtype=torch.int64), torch.zeros(0, 4))
    assert out.shape == (0, 3) and out.dtype == table.dtype
    out.sum().backward()
    assert table.grad is None or not table.grad.numel()


@pytest.mark.parametrize("trains", [False, True])
def test_weights_have_gradients_also_where_the_table_is_frozen(trains):
    values, rows, weights = lookup()
    table = Table(values, requires_grad=trains)
    interpolate(table, rows, weights.requires_grad_()).sum().backward()
    assert torch.equal(weights.grad, values[rows].sum(-1)) and (table.grad is not None) == trains


# Rows ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", ["side by side", "4096 apart", "anywhere"])
@pytest.mark.parametrize("count", [1, 7, 40_000])
def test_distinct_rows_are_those_of_the_reference(count, spread):
    g, different = torch.Generator().manual_seed(count), 1 + count // 3
    chosen = torch.randint(0, different, (count, 4), generator=g)
    anywhere = torch.randint(0, 2**27, (different,), generator=g)
    rows = {"side by side": chosen, "4096 apart": chosen * 4096, "anywhere": anywhere[chosen]}[spread]
    fast, plain = both(lambda: index_rows(rows, 2**27))
    assert torch.equal(fast.unique, plain.unique)
    assert fast.positions.shape == rows.shape and torch.equal(fast.unique[fast.positions.long()], rows)


@pytest.mark.parametrize("channels", [1, 9])
def test_gathered_rows_are_read_like_the_table_and_have_one_gradient_each(channels):
    rows, weights = torch.randint(0, 50, (80, 4), generator=torch.Generator().manual_seed(1)), torch.rand(80, 4)
    index = index_rows(rows, 2**27)
    some, upstream = torch.arange(0, 80, 3), normal(80, channels, seed=2)
    table, plain = Table(normal(50, channels)), normal(50, channels).requires_grad_()
    values = read_rows(table, index.unique)
    read = weigh_rows(values, index.positions, weights)
    part = weigh_rows(values, index.positions[some], weights[some])
    wanted = interpolate_densely(plain, rows, weights)
    assert torch.allclose(read, wanted, atol=1e-6) and torch.allclose(part, wanted[some], atol=1e-6)
    ((read * upstream).sum() + 2 * part.sum()).backward()
    ((wanted * upstream).sum() + 2 * wanted[some].sum()).backward()
    assert torch.equal(table.grad_rows, index.unique)
    assert torch.allclose(dense_grad(table), plain.grad, atol=1e-5)


@pytest.mark.parametrize("moves", [False, True])
def test_rows_around_samples_are_those_of_their_heads(moves):
    layout, g = random_field(3, True, seed=1).layout, torch.Generator().manual_seed(1)
    heads, ndc = torch.randint(0, 4, (300,), generator=g), normal(300, 3).clamp(-1.1, 1.1).requires_grad_(moves)
    planes = torch.randint(0, 12, (300,), generator=g)
    for rows, weights in both(lambda: texel_rows(layout, heads, planes, ndc)):
        for k, grid in enumerate(layout.grids):
            own, at = heads == k, ndc[heads == k]
            wanted = grid.bilinear(planes[own], at) if k < 3 else grid.trilinear(at)
            size = wanted[0].shape[1]
            assert torch.equal(rows[own][:, :size], wanted[0]) and torch.allclose(weights[own][:, :size], wanted[1])
            assert not weights[own][:, size:].any() and torch.equal(rows[own][:, -4:], wanted[0][:, -4:])


@pytest.mark.parametrize("threads", [3])
def test_bits_of_all_operations_on_rows_do_not_depend_on_threads(threads, monkeypatch):
    monkeypatch.setattr("mmpi_ns.ops.interpolate.AT_LEAST", 1000)
    rows = torch.randint(0, 2**20, (20_000,), generator=torch.Generator().manual_seed(1))[:, None] * 8 + torch.arange(4)
    values, weights, layout = normal(20_000, 9), normal(20_000, 4, seed=2).abs(), bricked_field().layout
    heads = torch.arange(20_000) % len(layout.mpis)
    ndc = normal(20_000, 3, seed=3).clamp(-1, 1)

    def work():
        index = index_rows(rows, 2**23 + 4)
        sums = sum_rows(index.positions, values, weights, len(index.unique))
        return index.unique, index.positions, sums, *texel_rows(layout, heads, heads, ndc)

    before, one = torch.get_num_threads(), work()
    try:
        torch.set_num_threads(threads)
        assert all(torch.equal(a, b) for a, b in zip(work(), one, strict=True))
    finally:
        torch.set_num_threads(before)
    assert one[2].abs().max() > 1
