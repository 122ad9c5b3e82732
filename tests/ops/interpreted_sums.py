"""Sums along rays, Adam and the use of bricks by Triton kernels against float64: run like interpreted_march.py."""

from __future__ import annotations

import pytest
import torch
from bricked import bricked_field
from interpreting import interpreted, normal  # noqa: F401

from mmpi_ns.ops.adam import AdamConstants, adam_rows
from mmpi_ns.ops.composite import composite_weights
from mmpi_ns.ops.depth_sums import depth_sums
from mmpi_ns.ops.gather import Taps
from mmpi_ns.ops.interpolate import index_rows, texel_rows
from mmpi_ns.ops.use import note_use
from mmpi_ns.scene.texels import BRICK


def slots(rays, width, seed=0):
    """Which slots of rays hold a sample; the first ray holds none."""
    counts = torch.randint(0, width + 1, (rays,), generator=torch.Generator().manual_seed(seed))
    counts[0] = 0
    return torch.arange(width) < counts[:, None]


@pytest.mark.parametrize("width", [1, 7, 130])
def test_weights_and_their_gradients_are_those_of_float64(width):
    valid, found = slots(70, width), []
    tau, before = normal(70, width).abs() ** 3, normal(70, width, seed=1).abs()
    tau[::5, width // 2] = 60.0
    total, up = normal(70, 1, seed=2).abs(), (normal(70, width, seed=3), normal(70, 1, seed=4), normal(70, 1, seed=5))
    for form, dtype in ((composite_weights, torch.float32), (composite_weights.reference, torch.float64)):
        x = tau.clone().to(dtype).requires_grad_()
        c = form(x, valid, before.to(dtype), total.to(dtype))
        sum((u.to(dtype) * v).sum() for u, v in zip(up, vars(c).values(), strict=True)).backward()
        found.append([v.detach().double() for v in (*vars(c).values(), x.grad)])
    for a, b in zip(*found, strict=True):
        assert b.abs().max() > 0.05 and torch.allclose(a, b, atol=3e-6 * max(1.0, float(b.abs().max())), rtol=2e-5)


@pytest.mark.parametrize("width", [1, 7, 130])
def test_sums_of_depth_and_their_gradients_are_those_of_float64(width):
    valid, found = slots(70, width), []
    inverse_t = torch.where(valid, normal(70, width).abs().sort(-1, descending=True).values, 0.0)
    weights = torch.where(valid, normal(70, width, seed=1).abs() / width, 0.0)
    targets = torch.stack([normal(70, seed=2).clamp(min=0), normal(70, seed=3).abs() + 0.1], -1)
    up = normal(70, seed=4), normal(70, seed=5)
    for form, dtype in ((depth_sums, torch.float32), (depth_sums.reference, torch.float64)):
        w = weights.clone().to(dtype).requires_grad_()
        s = form(w, inverse_t.to(dtype), valid, normal(70, seed=6).abs().to(dtype), targets.to(dtype), 0.7)
        ((up[0].to(dtype) * s.spread).sum() + (up[1].to(dtype) * s.mass).sum()).backward()
        found.append(
            [s.spread.detach().double(), s.mass.detach().double(), w.grad.double() * valid, s.reached.double()]
        )
    for a, b in zip(*found, strict=True):
        assert torch.allclose(a, b, atol=2e-6 * max(1.0, float(b.abs().max())), rtol=2e-5)


@pytest.mark.parametrize("channels", [1, 9])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
def test_adam_on_rows_is_that_of_float64_and_leaves_the_rest_alone(channels, dtype):
    rows = torch.cat([torch.arange(3), torch.arange(BRICK, 5 * BRICK, 3), torch.zeros(5, dtype=torch.int64)])
    grad = normal(len(rows), channels, seed=1)
    grad[::4] = 0
    param, moments = normal(5 * BRICK, channels), normal(5 * BRICK, 2, channels, seed=2).abs().to(dtype)
    constants = AdamConstants(0.9, 0.99, 0.3, 1e-8, 0.05)
    wanted = param.double(), moments.double()
    adam_rows.reference(*wanted, rows, grad.double(), constants)
    before = param.clone()
    adam_rows(param, moments, rows, grad, constants)
    assert torch.allclose(param.double(), wanted[0], atol=1e-6)
    assert torch.allclose(moments.double(), wanted[1], rtol=1e-2 if dtype == torch.bfloat16 else 1e-6)
    assert torch.equal(param[:BRICK], before[:BRICK]) and not torch.equal(param, before)


@pytest.mark.parametrize("gains", [True, False])
def test_bricks_are_used_as_the_reference_says(gains):
    g = torch.Generator().manual_seed(1)
    read = [torch.randint(0, 900, (120, 4), generator=g), torch.randint(0, 900, (50, 8), generator=g)]
    index = index_rows(torch.cat([x.reshape(-1) for x in read]), 900)
    taps = [
        Taps(p.view(x.shape), torch.ones(x.shape))
        for p, x in zip(index.positions.split([x.numel() for x in read]), read, strict=True)
    ]
    weights, order = normal(30, 9).abs(), torch.randperm(270, generator=g)[:170]
    weights[:5] = 0
    found = []
    for form in (note_use, note_use.reference):
        peak, gain = 0.3 * torch.ones(15), torch.ones(15)
        form(index.unique, taps, order, weights, normal(30, seed=3).abs(), peak, gain if gains else None)
        found.append((peak, gain))
    assert torch.equal(found[0][0], found[1][0]) and (found[0][0] > 0.3).any()
    assert torch.allclose(found[0][1], found[1][1], rtol=1e-5) and bool((found[0][1] != 1).any()) == gains


def test_texels_of_samples_are_those_of_the_reference():
    field, g = bricked_field(), torch.Generator().manual_seed(1)
    ndc = torch.rand(700, 3, generator=g) * 2.4 - 1.2
    heads, planes = torch.randint(0, 3, (700,), generator=g), torch.randint(0, 9, (700,), generator=g)
    rows, weights = texel_rows(field.layout, heads, planes, ndc)
    wanted = texel_rows.reference(field.layout, heads, planes, ndc)
    assert torch.equal(rows, wanted[0]) and torch.allclose(weights, wanted[1], atol=2e-6)
