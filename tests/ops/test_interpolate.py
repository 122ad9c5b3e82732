"""Weighted sums of table rows: the fast path equals the plain one, and its gradient is sparse (ops/interpolate.py)."""

from __future__ import annotations

import pytest
import torch
from compiled import both, compiled, normal  # noqa: F401

from mmpi_ns.ops.interpolate import (
    gather_rows,
    index_rows,
    interpolate,
    interpolate_gathered,
    raise_peaks,
    reference,
    sum_rows,
)

F64 = torch.float64


def lookup(samples=50, corners=4, rows=30, channels=5, dtype=F64, seed=0):
    g = torch.Generator().manual_seed(seed)
    return (
        torch.randn(rows, channels, generator=g, dtype=F64).to(dtype),
        torch.randint(0, rows, (samples, corners), generator=g),
        torch.rand(samples, corners, generator=g, dtype=F64).to(dtype),
    )


class DenseGradient(torch.autograd.Function):
    """The identity; gradcheck wants a dense gradient, so what comes back sparse is written out."""

    @staticmethod
    def forward(ctx, table):
        return table.view_as(table)

    @staticmethod
    def backward(ctx, grad):
        return grad.to_dense()


def test_interpolation_by_hand():
    table = torch.tensor([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]])
    rows, weights = torch.tensor([[0, 2], [1, 1]]), torch.tensor([[0.25, 0.75], [0.5, 0.5]])
    for function in (reference.interpolate, interpolate):
        assert function(table, rows, weights).tolist() == [[3.25, 32.5], [2.0, 20.0]]


@pytest.mark.parametrize("channels", [1, 3, 9])
@pytest.mark.parametrize("corners", [1, 4, 8])
@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 2e-6), (F64, 1e-14)])
def test_fast_path_equals_the_reference_with_its_gradient(channels, corners, dtype, error):
    table, rows, weights = lookup(channels=channels, corners=corners, dtype=dtype)
    fast, plain = table.clone().requires_grad_(), table.clone().requires_grad_()
    out, wanted = interpolate(fast, rows, weights), reference.interpolate(plain, rows, weights)
    assert out.shape == (50, channels) and torch.allclose(out, wanted, atol=error, rtol=error)
    upstream = torch.randn(50, channels, generator=torch.Generator().manual_seed(1), dtype=F64).to(dtype)
    out.backward(upstream)
    wanted.backward(upstream)
    assert fast.grad.is_sparse and not plain.grad.is_sparse
    assert torch.allclose(fast.grad.to_dense(), plain.grad, atol=10 * error, rtol=10 * error)


def test_sparse_gradient_is_that_of_finite_differences():
    table, rows, weights = lookup(samples=6, rows=7, channels=2)

    def read(t):
        return interpolate(DenseGradient.apply(t), rows, weights)

    assert torch.autograd.gradcheck(read, (table.requires_grad_(),))


def test_gradient_names_only_the_rows_that_were_read():
    table, rows, weights = lookup(samples=3, rows=1000)
    table.requires_grad_()
    interpolate(table, rows, weights).sum().backward()
    assert table.grad._nnz() <= rows.numel()
    assert set(table.grad.coalesce().indices()[0].tolist()) == set(rows.reshape(-1).tolist())


def test_two_lookups_in_one_table_add_their_gradients():
    table, rows, weights = lookup()
    fast, plain = table.clone().requires_grad_(), table.clone().requires_grad_()
    for t, function in ((fast, interpolate), (plain, reference.interpolate)):
        (function(t, rows, weights).sum() + 2 * (function(t, rows.flip(0), weights) ** 2).sum()).backward()
    assert fast.grad.is_sparse and torch.allclose(fast.grad.to_dense(), plain.grad)


def test_no_samples_give_no_values_and_no_gradient():
    table = torch.randn(5, 3, requires_grad=True)
    out = interpolate(table, torch.zeros(0, 4, dtype=torch.int64), torch.zeros(0, 4))
    assert out.shape == (0, 3) and out.dtype == table.dtype
    out.sum().backward()
    assert table.grad is None or table.grad.to_dense().abs().sum() == 0


def test_lookup_without_samples_leaves_the_gradient_of_others_sparse():
    """A head that covers no sample of a batch must not make the optimiser visit the whole table."""
    table, rows, weights = lookup()
    table.requires_grad_()
    empty = interpolate(table, rows[:0], weights[:0])
    (interpolate(table, rows[:2], weights[:2]).sum() + empty.sum()).backward()
    assert table.grad.is_sparse and set(table.grad.coalesce().indices()[0].tolist()) == set(rows[:2].view(-1).tolist())


def test_weights_of_another_precision_are_taken():
    table, rows, weights = lookup(dtype=torch.float32)
    assert torch.equal(interpolate(table, rows, weights.double()), interpolate(table, rows, weights))


@pytest.mark.parametrize("gathered", [False, True])
@pytest.mark.parametrize("trains", [False, True])
def test_gradients_of_weights_are_finite_differences(gathered, trains):
    """Also where the table is frozen, which then gets none."""
    table, rows, weights = lookup()
    table.requires_grad_(trains)
    look = interpolate_gathered if gathered else interpolate
    assert torch.autograd.gradcheck(lambda w: look(table.detach(), rows, w).sin(), (weights.requires_grad_(),))
    look(table, rows, weights).sum().backward()
    assert torch.equal(weights.grad, table.detach()[rows].sum(-1)) and (table.grad is not None) == trains


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
    assert fast.position.shape == rows.shape and torch.equal(fast.unique[fast.position.long()], rows)


def test_rows_of_a_table_too_large_to_mark_are_sorted():
    rows = torch.tensor([2**40, 3, 2**40, 2**31])
    index = index_rows(rows, 2**40 + 1)
    assert torch.equal(index.unique, torch.tensor([3, 2**31, 2**40]))
    assert torch.equal(index.unique[index.position.long()], rows)


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("channels", [1, 9])
def test_rows_gather_what_their_entries_give(channels, weighted):
    rows = torch.randint(0, 40, (300, 4 if weighted else 1), generator=torch.Generator().manual_seed(1))
    values, weights = normal(300, channels), torch.rand(300, 4) if weighted else None

    def work():
        index = index_rows(rows, 2**27)
        return torch.zeros(40, channels).index_copy_(
            0, index.unique, sum_rows(index.position, values, weights, len(index.unique))
        )

    fast, plain = both(work)
    assert plain.abs().max() > 1 and torch.allclose(fast, plain, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 9])
def test_gathered_rows_are_read_like_the_table_and_have_one_gradient_each(channels):
    rows, weights = torch.randint(0, 50, (80, 4), generator=torch.Generator().manual_seed(1)), torch.rand(80, 4)
    index = index_rows(rows, 2**27)
    some, upstream = torch.arange(0, 80, 3), normal(80, channels, seed=2)
    table, plain = (normal(50, channels).requires_grad_() for _ in range(2))
    gathered = gather_rows(table, index.unique)
    read = interpolate_gathered(gathered, index.position, weights)
    part = interpolate_gathered(gathered, index.position[some], weights[some])
    wanted = reference.interpolate(plain, rows, weights)
    assert torch.allclose(read, wanted, atol=1e-6) and torch.allclose(part, wanted[some], atol=1e-6)
    ((read * upstream).sum() + 2 * part.sum()).backward()
    ((wanted * upstream).sum() + 2 * wanted[some].sum()).backward()
    assert torch.equal(table.grad._indices()[0], index.unique)
    assert torch.allclose(table.grad.to_dense(), plain.grad, atol=1e-5)


@pytest.mark.parametrize("taps", [4, 8])
def test_a_bricks_peak_is_the_largest_weight_of_what_reads_it(taps):
    rows = torch.randint(0, 64 * 30, (500, taps), generator=torch.Generator().manual_seed(taps))
    weights, peaks = normal(500).abs(), 0.5 * normal(40, seed=1).abs()
    wanted = peaks.clone()
    for row, weight in zip(rows.tolist(), weights, strict=True):
        for brick in {r // 64 for r in row}:
            wanted[brick] = max(wanted[brick], weight)

    def raised():
        found = peaks.clone()
        raise_peaks(found, rows, weights)
        return found

    assert all(torch.equal(found, wanted) for found in both(raised)) and not torch.equal(peaks, wanted)
