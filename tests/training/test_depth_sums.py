"""The sums of the depth losses against double loops in float64, and their gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from compiled import both, compiled  # noqa: F401
from hand_made import starts_of

from mmpi_ns.ops.depth_sums import depth_sums

HARD = {
    "random": {},
    "one sample": {"samples": 1},
    "no sample": {"samples": 0},
    "opaque": {"opaque": True},
    "ties": {"ties": True},
    "no target": {"target": 0.0},
    "infinity": {"first": 1e30},
    "tiny": {"scale": 1e-5},
    "huge": {"scale": 1e5},
}


def rays(samples=24, opaque=False, ties=False, target=1.0, first=3.0, scale=1.0, count=70, slots=24):
    """Samples of rays, front to back, of which some slots are empty."""
    rng = np.random.default_rng(samples)
    inverse_t = -np.sort(-rng.uniform(0.0, 2.0, (count, slots)), -1)
    inverse_t[:, 0] = first
    if ties:
        inverse_t = inverse_t.round(1)
    weights = rng.dirichlet(np.full(slots, 0.3), count)
    if opaque:
        weights = np.eye(slots)[rng.integers(0, slots, count)]
    valid = (np.arange(slots) < samples) & (rng.random((count, slots)) < 0.9)
    targets = np.stack([target * rng.uniform(0.1, 1.9, count), rng.uniform(0.001, 0.3, count)], -1)
    return weights * valid, inverse_t * scale, valid, rng.uniform(0.01, 0.1, count), targets * scale, 0.7 / scale


def oracle(weights, inverse_t, valid, intervals, targets, scale):
    """Every pair of samples, as in mip-NeRF 360 eq. (15), and every sample's window, with gradients of the weights."""
    count = len(weights)
    spread, mass, reached = np.zeros(count), np.zeros(count), np.zeros(count, bool)
    d_spread, d_mass = np.zeros_like(weights), np.zeros_like(weights)
    for r in range(count):
        chosen = np.nonzero(valid[r])[0]
        for i in chosen:
            for j in chosen:
                apart = abs(1 / (1 + scale * inverse_t[r, i]) - 1 / (1 + scale * inverse_t[r, j]))
                spread[r] += weights[r, i] * weights[r, j] * apart
                d_spread[r, i] += 2 * weights[r, j] * apart
            spread[r] += weights[r, i] ** 2 * intervals[r] / 3
            d_spread[r, i] += 2 * weights[r, i] * intervals[r] / 3
            away = (inverse_t[r, i] - targets[r, 0]) / targets[r, 1]
            d_mass[r, i] = np.exp(-0.5 * min(away**2, 700))
            mass[r] += weights[r, i] * d_mass[r, i]
            reached[r] |= abs(away) < 3 and targets[r, 0] > 0
    return spread, mass, reached, d_spread, d_mass


@pytest.mark.parametrize("case", HARD)
def test_sums_and_gradients_equal_the_double_loops(case):
    *arrays, scale = rays(**HARD[case])
    spread, mass, reached, d_spread, d_mass = oracle(*(x.astype(np.float64) for x in arrays[:2]), *arrays[2:], scale)
    weights, inverse_t, intervals, targets = (torch.from_numpy(x).float() for x in arrays if x.dtype != bool)
    valid = torch.from_numpy(arrays[2])
    samples = (weights.requires_grad_()[valid], inverse_t[valid], starts_of(valid), intervals, targets, scale)
    for sums in both(lambda: depth_sums(*samples)):
        check(sums, weights, valid, spread, mass, reached, d_spread, d_mass)


def check(sums, weights, valid, spread, mass, reached, d_spread, d_mass):
    np.testing.assert_allclose(sums.spread.detach(), spread, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(sums.mass.detach(), mass, rtol=2e-3, atol=1e-5)
    # float32 may place a sample at exactly three widths on either side
    assert (sums.reached.numpy() != reached).mean() < 0.02
    up, down = torch.linspace(-1, 2, len(weights)), torch.linspace(3, -1, len(weights))
    (gradient,) = torch.autograd.grad((up * sums.spread + down * sums.mass).sum(), weights, retain_graph=True)
    expected = up.numpy()[:, None] * d_spread + down.numpy()[:, None] * d_mass
    np.testing.assert_allclose(gradient.numpy()[valid], expected[valid], rtol=3e-3, atol=3e-5)
