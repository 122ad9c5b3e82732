"""Samples with known texels for tests of what rays gather (ops/gather)."""

from __future__ import annotations

import numpy as np
import torch

from mmpi_ns.ops.gather import Taps


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
