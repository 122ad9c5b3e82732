"""Merged transmittance, sample by sample, and what a ray gathers, also on hard rays (ops/composite)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import oracle
import pytest
import torch
from compiled import both, compiled  # noqa: F401
from hand_made import starts_of, tensor

from mmpi_ns.ops.composite import (
    composite_weights,
    median_inverse_distance,
    ray_numbers,
    render_colors,
    sum_before,
    sum_by_ray,
    winning_heads,
)

STARTS = torch.tensor([0, 0, 3, 4, 4])


def test_samples_behind_the_last_ray_belong_to_none():
    numbers = ray_numbers(STARTS, 6)
    assert numbers.tolist() == [1, 1, 1, 2, 4, 4]
    assert sum_by_ray(tensor([1.0, 2.0, 4.0, 8.0, 16.0, 32.0]), STARTS, numbers).tolist() == [0, 7, 8, 0]
    assert ray_numbers(STARTS[:1], 0).tolist() == [] == sum_by_ray(tensor([]), STARTS[:1], numbers[:0]).tolist()


def test_sums_of_what_came_before_are_of_the_ray_alone():
    numbers = ray_numbers(STARTS, 4)
    assert sum_before(tensor([1.0, 2.0, 4.0, 8.0]), STARTS, numbers).tolist() == [0, 1, 3, 0]
    for large in (1e9, math.inf, math.nan):
        assert sum_before(torch.tensor([0.125, large, 0.5, 0.5]), STARTS, numbers)[[0, 1, 3]].tolist() == [0, 0.125, 0]


def test_weights_of_a_hand_computed_ray():
    tau = tensor([math.log(2), math.log(4), 0.0, math.log(2), 5.0])  # alpha 1/2, 3/4, 0, 1/2, and one of no ray
    composite = composite_weights(tau, torch.tensor([0, 4]), torch.zeros_like(tau), tensor([[0.0]]))
    assert composite.weights.tolist() == pytest.approx([1 / 2, 3 / 8, 0, 1 / 16, 0])
    assert composite.mass.item() == pytest.approx(15 / 16) == composite.accumulation.item()
    assert composite.transmittance.item() == pytest.approx(1 / 16)


def test_dropped_mass_takes_the_mean_colour_of_what_was_kept():
    tau, starts = tensor([0.2, 0.4]), torch.tensor([0, 2])
    composite = composite_weights(tau, starts, torch.zeros_like(tau), tensor([[0.5]]))
    colors = tensor([[1.0, 0.0, 0.2], [0.0, 1.0, 0.2]])
    w = oracle.composite([0.2, 0.4]).weights
    expected = (1 - math.exp(-1.1)) * np.array([w[0], w[1], 0.2 * w.sum()]) / w.sum()
    assert render_colors(composite, colors, starts)[0].tolist() == pytest.approx(list(expected))


def test_median_distance_is_where_half_of_the_gathered_weight_is_reached():
    inverse_t = tensor([4.0, 3.0, 2.0, 1.0, 0.0]).repeat(5)
    weights = tensor(
        [
            [0.1, 0.2, 0.4, 0.2, 0.1],
            [0.25, 0.25, 0.25, 0.25, 0.0],  # exactly half after the second
            [0.0, 0.0, 0.0, 0.0, 1e-3],  # all at infinity
            [0.0, 0.0, 1e-30, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0],
        ]
    )
    starts = torch.tensor([0, 0, 5, 10, 15, 20, 25])
    median = median_inverse_distance(weights.flatten(), inverse_t, starts)
    assert median[:, 0].tolist() == [0.0, 2.0, 3.0, 0.0, 2.0, 0.0]
    heads = torch.tensor([0, 1, 2, 1, 0]).repeat(5)
    assert winning_heads(weights.flatten(), heads, starts, 3)[:, 0].tolist() == [0, 1, 1, 0, 2, 0]


def batch(rays=60, slots=37):
    """Optical depths from 1e-7 to 1e3, some exactly 0, in rays of 0 to as many samples, with dropped ones between."""
    g = torch.Generator().manual_seed(rays)
    tau = 10 ** (torch.rand(rays, slots, generator=g) * torch.linspace(1, 10, rays)[:, None] - 7)
    tau[torch.rand(rays, slots, generator=g) < 0.05] = 0
    count = torch.randint(0, slots + 1, (rays,), generator=g)
    count[:2] = torch.tensor([0, slots])
    valid = torch.arange(slots) < count[:, None]
    skipped = 0.01 * torch.rand(rays, slots, generator=g).cumsum(-1)
    return tau[valid], starts_of(valid), skipped[valid], skipped[:, -1:] + 0.02


def weights_and_gradient(given, dtype):
    tau, starts, before, total = given
    tau = tau.detach().to(dtype).requires_grad_()
    made = composite_weights(tau, starts, before.to(dtype), total.to(dtype))
    g = torch.Generator().manual_seed(1)
    parts = (made.weights, made.mass, made.accumulation, made.transmittance)
    sum((p * torch.randn(p.shape, generator=g)).sum() for p in parts).backward()
    return (*(p.detach() for p in parts), tau.grad)


@pytest.mark.parametrize("slots", [1, 16, 37])
def test_weights_and_their_gradient_equal_float64(slots):
    given = batch(slots=slots)
    wanted = weights_and_gradient(given, torch.float64)
    for actual in both(lambda: weights_and_gradient(given, torch.float32)):
        for a, b in zip(actual, wanted, strict=True):
            assert ((a.double() - b).abs() <= 3e-6 * (1 + b.abs())).all()
        thin = (given[0] < 1e-4) & (wanted[0] > 0.5 * given[0]) & (given[0] > 0)
        assert thin.any() and ((actual[0].double() - wanted[0]).abs()[thin] <= 1e-5 * wanted[0][thin]).all()


def test_opaque_and_infinite_samples_hide_what_lies_behind():
    wanted = torch.tensor([1 - math.exp(-0.1), math.exp(-0.1), 0.0, 1.0, 0.0, 0.0])

    def work():
        tau = torch.tensor([0.1, 200.0, 3.0, math.inf, 1.0, 1.0], requires_grad=True)
        made = composite_weights(tau, torch.tensor([0, 3, 6]), torch.zeros(6), torch.zeros(2, 1))
        assert torch.allclose(made.weights, wanted, atol=1e-6)
        assert made.transmittance.tolist() == [[0.0], [0.0]] and made.accumulation.tolist() == [[1.0], [1.0]]
        made.weights[[2, 5]].sum().backward()
        assert tau.grad.isfinite().all() and tau.grad.abs().max() < 1e-30

    both(work)


def test_a_depth_that_is_not_a_number_is_not_hidden():
    tau, starts = torch.tensor([0.1, math.nan, 0.3, 0.1, 0.2, 0.3]), torch.tensor([0, 3, 6])
    for made in both(lambda: composite_weights(tau, starts, torch.zeros(6), torch.zeros(2, 1))):
        assert made.weights[1].isnan() and made.accumulation[0].isnan() and made.transmittance[0].isnan()
        assert made.weights[3:].isfinite().all() and render_colors(made, torch.ones(6, 3), starts)[0].isnan().all()


def test_colours_of_rays_and_their_gradients_equal_float64():
    given, g = batch(), torch.Generator().manual_seed(2)
    colors, upstream = torch.rand(len(given[0]), 3, generator=g), torch.randn(60, 3, generator=g)
    actual = []
    for dtype in (torch.float32, torch.float64):
        made = composite_weights(*(x.to(dtype) if x.is_floating_point() else x for x in given))
        weights, own = made.weights.requires_grad_(), colors.detach().to(dtype).requires_grad_()
        rgb = render_colors(replace(made, weights=weights), own, given[1])
        (rgb * upstream).sum().backward()
        actual.append((rgb.detach(), weights.grad, own.grad))
    for a, b in zip(*actual, strict=True):
        assert b.abs().max() > 0.1 and ((a.double() - b).abs() <= 5e-5 * b.abs() + 2e-6).all()
