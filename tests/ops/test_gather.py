"""What rays gather of texels, and its gradients: compiled and plain against float64 (ops/gather)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from mmpi_ns.ops.composite import ray_numbers
from mmpi_ns.ops.gather import Taps, gather_taps

CHANNELS = (3, 8, 9, 16, 20)


def batch(channels, seed=0, rays=7, width=6, taps=8):
    """Values, taps, starts, weights and wanted rays in float64."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[0], np.cumsum(rng.integers(0, width + 1, rays))])
    count, values = starts[-1], torch.tensor(rng.normal(size=(30, channels)) * 2)
    shares = torch.tensor(rng.dirichlet(np.ones(taps), count))
    weights = torch.tensor(rng.random(count))
    wanted = torch.tensor(rng.permutation(rays) > rays // 4)
    return values, Taps(torch.tensor(rng.integers(0, 30, (count, taps))), shares), torch.tensor(starts), weights, wanted


def parts_of(sums):
    return sums.gathered, sums.mass, sums.first, sums.second


def in_float32(given):
    values, taps, starts, weights, wanted = given
    return values.float(), Taps(taps.positions, taps.weights.float()), starts, weights.float(), wanted


def with_gradients(function, given, upstream, moved=False):
    """Sums and gradients of values and weights, and of shares where samples are moved."""
    values, weights = (x.clone().requires_grad_() for x in (given[0], given[3]))
    shares = given[1].weights.clone().requires_grad_(moved)
    sums = function(values, Taps(given[1].positions, shares), given[2], weights, given[4])
    chosen = [s for s in parts_of(sums) if s.requires_grad]
    grads = [u for u, s in zip(upstream, parts_of(sums), strict=True) if s.requires_grad]
    torch.autograd.backward(chosen, [g.to(s.dtype) for g, s in zip(grads, chosen, strict=True)])
    to_shares = [shares.grad] if moved else []
    return [x.double() for x in (*(s.detach() for s in parts_of(sums)), values.grad, weights.grad, *to_shares)]


def values_by_hand(raw):
    return np.array([1 / (1 + math.exp(-x)) if c < 3 else math.tanh(x) for c, x in enumerate(raw)])


def sums_by_hand(values, samples, starts, weights, wanted):
    """(gathered, mass, first, second) of every ray; samples are lists of (row, share)."""
    out = [np.zeros((len(wanted), n)) for n in (values.shape[1], 1, 3, 3)]
    for ray in np.flatnonzero(wanted):
        for i in range(starts[ray], starts[ray + 1]):
            value = values_by_hand(sum(share * values[row] for row, share in samples[i]))
            for total, part in zip(out, (value, np.ones(1), value[:3], value[:3] ** 2), strict=True):
                total[ray] += weights[i] * part
    return out


@pytest.mark.parametrize("function", [gather_taps, gather_taps.reference])
@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("count", [4, 8])
def test_sums_are_those_of_loops(function, channels, count):
    given = batch(channels, taps=count)
    values, taps, starts, weights, wanted = given
    samples = [list(zip(*x, strict=True)) for x in zip(taps.positions.tolist(), taps.weights.tolist(), strict=True)]
    wanted_sums = sums_by_hand(values.numpy(), samples, starts.tolist(), weights.numpy(), wanted.tolist())
    actual = function(*in_float32(given))
    for a, b in zip(parts_of(actual), wanted_sums, strict=True):
        assert np.abs(a.numpy() - b).max() < 1e-6
    assert wanted_sums[1].max() > 0.5 and not wanted.all() and (starts.diff() == 0).any()


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("moved", [False, True])
def test_gradients_are_those_of_float64(channels, seed, moved):
    given = batch(channels, seed)
    g = torch.Generator().manual_seed(seed)
    upstream = [torch.randn(7, n, generator=g, dtype=torch.float64) for n in (channels, 1, 3, 3)]
    fast, exact = (
        with_gradients(f, x, upstream, moved)
        for f, x in ((gather_taps, in_float32(given)), (gather_taps.reference, given))
    )
    assert len(fast) == (7 if moved else 6)
    for a, b in zip(fast, exact, strict=True):
        assert b.abs().max() > 0.05 and (a - b).abs().max() < 3e-6 * (1 + b.abs().max())


def test_reference_gradients_are_finite_differences():
    values, taps, starts, weights, wanted = batch(5)

    def sums(values, weights, shares):
        return gather_taps.reference(values, Taps(taps.positions, shares), starts, weights, wanted).gathered

    def moments(values):
        actual = gather_taps.reference(values, taps, starts, weights, wanted)
        return actual.first, actual.second

    leaves = [x.clone().requires_grad_() for x in (values, weights, taps.weights)]
    assert torch.autograd.gradcheck(sums, leaves)
    values.requires_grad_()
    assert torch.autograd.gradcheck(moments, (values,))


# Hard inputs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", [gather_taps, gather_taps.reference])
def test_saturated_texels_are_colours_and_features_of_0_and_1_with_finite_gradients(form):
    values = torch.tensor([[200.0, -200.0, 30.0, 200.0, -200.0]], requires_grad=True)
    taps = Taps(torch.zeros(1, 4, dtype=torch.int64), torch.full((1, 4), 0.25))
    weights = torch.ones(1, requires_grad=True)
    sums = form(values, taps, torch.tensor([0, 1]), weights)
    assert sums.gathered.tolist() == [pytest.approx([1, 0, 1, 1, -1], abs=1e-12)]
    (sums.gathered.sum() + sums.second.sum()).backward()
    assert values.grad.isfinite().all() and weights.grad.isfinite().all()


def test_what_is_not_a_number_stays_in_its_own_sample():
    values, taps, starts, weights, _ = in_float32(batch(9, taps=4))
    plain = gather_taps(values, taps, starts, weights).gathered
    rays = torch.zeros(7, dtype=torch.bool)
    rays[ray_numbers(starts, len(weights))[(taps.positions == 4).any(-1)]] = True
    values[4] = torch.nan
    actual = gather_taps(values, taps, starts, weights).gathered
    assert rays.any() and not rays.all()
    assert actual[rays].isnan().all() and torch.equal(actual[~rays], plain[~rays])
