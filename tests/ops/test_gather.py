"""What rays gather of texels, and its gradients: compiled and plain against float64 (ops/gather)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from random_fields import bundle, random_field, random_rays, sampled

from mmpi_ns.ops.gather import Taps, gather_places, gather_taps

CHANNELS = (3, 8, 9, 16, 20)


def batch(channels, seed=0, rays=7, width=6, in_cube=True):
    """Values, groups, slots, weights and wanted rays in float64; slots of a group rise, as in a lookup."""
    rng = np.random.default_rng(seed)
    taken = rng.permutation(rays * width)[: rays * width * 2 // 3]
    cut = len(taken) * 3 // 4 if in_cube else len(taken)
    parts = [np.sort(taken[:cut]), np.sort(taken[cut:])]
    values = torch.tensor(rng.normal(size=(30, channels)) * 2)
    groups = [
        Taps(torch.tensor(rng.integers(0, 30, (len(p), taps))), torch.tensor(rng.dirichlet(np.ones(taps), len(p))))
        for p, taps in zip(parts, (4, 8), strict=True)
        if len(p)
    ]
    weights = torch.tensor(rng.dirichlet(np.ones(width), rays))
    wanted = torch.tensor(rng.permutation(rays) > rays // 4)
    return values, groups, torch.tensor(np.concatenate(parts)), weights, wanted


def parts_of(sums):
    return sums.gathered, sums.mass, sums.first, sums.second


def in_float32(given):
    values, groups, slots, weights, wanted = given
    return values.float(), [Taps(g.positions, g.weights.float()) for g in groups], slots, weights.float(), wanted


def with_gradients(function, given, upstream, moved=False):
    """Sums and gradients of values and weights, and of shares where samples are moved."""
    values, weights = (x.clone().requires_grad_() for x in (given[0], given[3]))
    groups = [Taps(g.positions, g.weights.clone().requires_grad_(moved)) for g in given[1]]
    sums = function(values, groups, given[2], weights, given[4])
    chosen = [s for s in parts_of(sums) if s.requires_grad]
    grads = [u for u, s in zip(upstream, parts_of(sums), strict=True) if s.requires_grad]
    torch.autograd.backward(chosen, [g.to(s.dtype) for g, s in zip(grads, chosen, strict=True)])
    to_shares = [g.weights.grad for g in groups] if moved else []
    return [x.double() for x in (*(s.detach() for s in parts_of(sums)), values.grad, weights.grad, *to_shares)]


def values_by_hand(raw):
    return np.array([1 / (1 + math.exp(-x)) if c < 3 else math.tanh(x) for c, x in enumerate(raw)])


def sums_by_hand(values, samples, slots, weights, wanted):
    """(gathered, mass, first, second) of every ray; samples are lists of (row, share)."""
    rays, channels = weights.shape[0], values.shape[1]
    out = [np.zeros((rays, n)) for n in (channels, 1, 3, 3)]
    for taps, slot in zip(samples, slots, strict=True):
        ray, weight = slot // weights.shape[1], weights.flat[slot]
        if not wanted[ray]:
            continue
        value = values_by_hand(sum(share * values[row] for row, share in taps))
        for total, part in zip(out, (value, np.ones(1), value[:3], value[:3] ** 2), strict=True):
            total[ray] += weight * part
    return out


@pytest.mark.parametrize("function", [gather_taps, gather_taps.reference])
@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("in_cube", [False, True])
def test_sums_are_those_of_loops(function, channels, in_cube):
    given = batch(channels, in_cube=in_cube)
    values, groups, slots, weights, wanted = given
    samples = [
        list(zip(p.tolist(), s.tolist(), strict=True))
        for g in groups
        for p, s in zip(g.positions, g.weights, strict=True)
    ]
    wanted_sums = sums_by_hand(values.numpy(), samples, slots.tolist(), weights.numpy(), wanted.tolist())
    actual = function(*in_float32(given))
    for a, b in zip(parts_of(actual), wanted_sums, strict=True):
        assert np.abs(a.numpy() - b).max() < 1e-6
    assert wanted_sums[1].max() > 0.5 and not wanted.all()


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
    assert len(fast) == (8 if moved else 6)
    for a, b in zip(fast, exact, strict=True):
        assert b.abs().max() > 0.05 and (a - b).abs().max() < 3e-6 * (1 + b.abs().max())


def test_reference_gradients_are_finite_differences():
    values, groups, slots, weights, wanted = batch(5)

    def sums(values, weights, *shares):
        taps = [Taps(g.positions, s) for g, s in zip(groups, shares or [g.weights for g in groups], strict=True)]
        return gather_taps.reference(values, taps, slots, weights, wanted).gathered

    def moments(values):
        actual = gather_taps.reference(values, groups, slots, weights, wanted)
        return actual.first, actual.second

    shares = [g.weights.clone().requires_grad_() for g in groups]
    assert torch.autograd.gradcheck(sums, (values.requires_grad_(), weights.clone().requires_grad_(), *shares))
    assert torch.autograd.gradcheck(moments, (values,))


# At places -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("with_cube", [False, True])
def test_at_places_sums_are_those_at_their_taps(with_cube):
    field = random_field(3, with_cube, seed=7)
    rays, samples = sampled(field, bundle(*random_rays(field.plan, 60, seed=8)))
    lookup = field.optical_depths(rays, samples)[1]
    weights = torch.rand(lookup.shape, generator=torch.Generator().manual_seed(0))
    places = samples.places
    table, everything = field.features.data, torch.ones(60, dtype=torch.bool)
    taps = [Taps(lookup.rows[t.positions], t.weights.double()) for t in lookup.taps]
    exact = gather_taps.reference(table.double(), taps, lookup.index, weights.double(), everything)
    actual = gather_places(field.layout, table, places, weights)
    for a, b in zip(parts_of(actual), parts_of(exact), strict=True):
        assert b.abs().max() > 1 and (a - b).abs().max() < 2e-5
    assert samples.heads.unique().numel() == 3 + with_cube


# Hard inputs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", [gather_taps, gather_taps.reference])
def test_saturated_texels_are_colours_and_features_of_0_and_1_with_finite_gradients(form):
    values = torch.tensor([[200.0, -200.0, 30.0, 200.0, -200.0]], requires_grad=True)
    taps = [Taps(torch.zeros(1, 4, dtype=torch.int64), torch.full((1, 4), 0.25))]
    weights = torch.ones(1, 1, requires_grad=True)
    sums = form(values, taps, torch.zeros(1, dtype=torch.int64), weights, torch.ones(1, dtype=torch.bool))
    assert sums.gathered.tolist() == [pytest.approx([1, 0, 1, 1, -1], abs=1e-12)]
    (sums.gathered.sum() + sums.second.sum()).backward()
    assert values.grad.isfinite().all() and weights.grad.isfinite().all()


def test_what_is_not_a_number_stays_in_its_own_sample():
    values, groups, slots, weights, wanted = in_float32(batch(9, in_cube=False))
    wanted[:] = True
    plain = gather_taps(values, groups, slots, weights, wanted).gathered
    hit = (groups[0].positions == 4).any(-1)
    rays = torch.zeros(7, dtype=torch.bool)
    rays[slots[hit] // 6] = True
    values[4] = torch.nan
    actual = gather_taps(values, groups, slots, weights, wanted).gathered
    assert rays.any() and not rays.all()
    assert actual[rays].isnan().all() and torch.equal(actual[~rays], plain[~rays])
