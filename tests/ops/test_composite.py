"""Merged transmittance, sample by sample, and what a ray gathers (ops/composite)."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from hand_made import tensor
from hypothesis import given, settings
from hypothesis import strategies as st

from mmpi_ns.blending import blend_shares, blended_optical_depth
from mmpi_ns.ops.composite import composite_weights, exclusive_cumsum, median_inverse_distance, render_colors

F64 = torch.float64


def composite_all(tau, valid=None):
    valid = torch.ones_like(tau, dtype=torch.bool) if valid is None else valid
    return composite_weights.reference(tau, valid, torch.zeros_like(tau), torch.zeros_like(tau[:, :1]))


def test_exclusive_cumsum_sums_what_came_before():
    assert exclusive_cumsum(tensor([[1.0, 2.0, 4.0], [0.5, 0.0, 8.0]])).tolist() == [[0, 1, 3], [0, 0.5, 0.5]]
    small_then_huge = torch.tensor([[0.125, 1e9, 0.5]], dtype=torch.float32)
    assert exclusive_cumsum(small_then_huge)[0, 1] == 0.125  # a difference of sums would say 0


def test_weights_of_a_hand_computed_ray():
    tau = tensor([[math.log(2), math.log(4), 0.0, math.log(2)]])  # alpha 1/2, 3/4, 0, 1/2
    composite = composite_all(tau)
    assert composite.weights[0].tolist() == pytest.approx([1 / 2, 3 / 8, 0, 1 / 16])
    assert composite.transmittance.item() == pytest.approx(1 / 16)
    assert composite.accumulation.item() == pytest.approx(15 / 16)


def test_alpha_zero_everywhere_gathers_exactly_nothing():
    composite = composite_all(torch.zeros(2, 50))
    assert composite.weights.abs().sum() == 0
    assert composite.accumulation.tolist() == [[0.0]] * 2 and composite.transmittance.tolist() == [[1.0]] * 2


def test_alpha_one_everywhere_stops_at_the_first_sample():
    composite = composite_all(torch.full((2, 50), 1e4))
    assert composite.weights[:, 0].tolist() == [1.0, 1.0] and composite.weights[:, 1:].abs().sum() == 0
    assert composite.accumulation.tolist() == [[1.0]] * 2 and composite.transmittance.tolist() == [[0.0]] * 2


def test_thin_samples_keep_their_relative_precision_in_float32():
    tau = tensor(10 ** np.random.default_rng(3).uniform(-12, -4, size=(1, 200)), torch.float32)
    composite = composite_all(tau)
    wanted = oracle.composite(tau[0].double().tolist())
    assert np.allclose(composite.weights[0], wanted.weights, rtol=1e-6, atol=0)
    assert composite.accumulation.item() == pytest.approx(-math.expm1(-tau.double().sum().item()), rel=1e-6)


@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 2e-6), (F64, 1e-13)])
@pytest.mark.parametrize("mean_depth", [1e-6, 1e-3, 1.0])
def test_ten_thousand_samples_equal_the_oracle(mean_depth, dtype, error):
    rng = np.random.default_rng(1)
    tau = tensor(rng.exponential(mean_depth, size=(1, 10_000)), dtype)
    tau[0, 9_000] = 1e4
    wanted = oracle.composite(tau[0].double().tolist())
    composite = composite_all(tau)
    assert np.abs(composite.weights[0].double().numpy() - wanted.weights).max() < error
    assert abs(composite.weights.double().sum().item() - 1) < 20 * error
    assert abs(composite.transmittance.item() - wanted.transmittance) < error


def test_empty_slots_hold_nothing_whatever_is_in_them():
    tau = tensor([[0.3, math.nan, 0.5, math.inf]]).requires_grad_()
    valid = torch.tensor([[True, False, True, False]])
    composite = composite_all(tau, valid)
    wanted = oracle.composite([0.3, 0.5])
    assert composite.weights[0].tolist() == pytest.approx([wanted.weights[0], 0, wanted.weights[1], 0])
    assert composite.transmittance.item() == pytest.approx(wanted.transmittance)
    composite.weights.sum().backward()
    assert torch.isfinite(tau.grad).all() and tau.grad[0, 1] == tau.grad[0, 3] == 0


def test_ray_that_meets_nothing_is_transparent_at_infinite_depth():
    tau = torch.full((1, 3), 5.0)
    valid = torch.zeros(1, 3, dtype=torch.bool)
    composite = composite_all(tau, valid)
    assert composite.transmittance.item() == 1 and composite.accumulation.item() == 0
    assert render_colors(composite, torch.rand(1, 3, 3)).tolist() == [[0.0, 0.0, 0.0]]
    assert median_inverse_distance(composite.weights, torch.ones(1, 3), valid).item() == 0


def test_dropped_samples_keep_their_transmittance():
    rng = np.random.default_rng(2)
    tau = rng.exponential(0.2, size=40)
    kept = rng.random(40) < 0.5
    whole = oracle.composite(tau)
    before = np.array([tau[:i][~kept[:i]].sum() for i in np.flatnonzero(kept)])
    composite = composite_weights.reference(
        tensor(tau[kept])[None],
        torch.ones(1, int(kept.sum()), dtype=torch.bool),
        tensor(before)[None],
        tensor([[tau[~kept].sum()]]),
    )
    assert np.allclose(composite.weights[0], whole.weights[kept], rtol=1e-12)
    assert composite.accumulation.item() == pytest.approx(whole.accumulation)
    assert composite.transmittance.item() == pytest.approx(whole.transmittance)


def test_dropped_mass_takes_the_mean_colour_of_what_was_kept():
    tau = tensor([[0.2, 0.4]])
    valid = torch.ones(1, 2, dtype=torch.bool)
    composite = composite_weights.reference(tau, valid, torch.zeros_like(tau), tensor([[0.5]]))
    colors = tensor([[[1.0, 0.0, 0.2], [0.0, 1.0, 0.2]]])
    w = oracle.composite([0.2, 0.4]).weights
    expected = (1 - math.exp(-1.1)) * np.array([w[0], w[1], 0.2 * w.sum()]) / w.sum()
    assert render_colors(composite, colors)[0].tolist() == pytest.approx(list(expected))


def test_median_distance_is_where_half_of_the_gathered_weight_is_reached():
    inverse_t = tensor([[4.0, 3.0, 2.0, 1.0, 0.0]]).expand(5, -1)
    weights = tensor(
        [
            [0.1, 0.2, 0.4, 0.2, 0.1],
            [0.25, 0.25, 0.25, 0.25, 0.0],  # exactly half after the second
            [0.0, 0.0, 0.0, 0.0, 1e-3],  # all at infinity
            [0.0, 0.0, 1e-30, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0],
        ]
    )
    median = median_inverse_distance(weights, inverse_t, torch.ones(5, 5, dtype=torch.bool))
    assert median[:, 0].tolist() == [2.0, 3.0, 0.0, 2.0, 0.0]


# A whole ray ---------------------------------------------------------------------------------------------------------


def random_sample(rng, head, plane, heads, scale, inverse_t):
    tau, votes = float(10 ** rng.uniform(-4, 2)), random_votes_of(rng, head, heads, scale)
    return oracle.RaySample(head, plane, float(inverse_t), tau, rng.random(3), *votes)


def random_samples(rng, heads, scale):
    """Samples of every head, some at equal distances."""
    distances = -np.sort(-rng.integers(0, 30, size=(heads, 9)) / 16.0, axis=-1)
    return [
        [random_sample(rng, head, plane, heads, scale, q) for plane, q in enumerate(distances[head])]
        for head in range(heads)
    ]


def random_votes_of(rng, own, heads, scale):
    cover = rng.random(heads) < 0.7
    cover[own] = True
    return rng.normal(size=heads) * scale, cover


@pytest.mark.parametrize(("heads", "scale"), [(1, 1.0), (2, 3.0), (5, 1.0), (12, 1e3)])
@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 3e-4), (F64, 1e-10)])
def test_merged_ray_equals_the_sequential_oracle(heads, scale, dtype, error):
    by_head = random_samples(np.random.default_rng(heads), heads, scale)
    ray = oracle.render_ray(by_head)
    samples = [s for head in by_head for s in head]
    samples = [samples[i] for i in np.argsort([-s.inverse_t for s in samples], kind="stable")]
    stack = {
        name: tensor(np.array([getattr(s, name) for s in samples]), dtype)
        for name in ("tau", "reliability", "inverse_t", "color")
    }
    cover = torch.tensor(np.array([s.cover for s in samples]))
    shares = blend_shares(stack["reliability"], cover, torch.tensor([s.head for s in samples]))
    tau = blended_optical_depth(stack["tau"], *shares)[None]
    composite = composite_all(tau)
    color = render_colors(composite, stack["color"][None])
    median = median_inverse_distance(composite.weights, stack["inverse_t"][None], torch.ones_like(tau).bool())
    assert np.abs(composite.weights[0].double().numpy() - ray.weights).max() < error
    assert np.abs(color[0].double().numpy() - ray.color).max() < error
    assert abs(composite.accumulation.item() - ray.accumulation) < error
    assert median.item() == ray.median_inverse_distance


@settings(max_examples=60)
@given(st.lists(st.floats(0, 50), min_size=1, max_size=40))
def test_weights_and_transmittance_share_out_all_light(taus):
    composite = composite_all(tensor([taus]))
    assert composite.weights.sum().item() + composite.transmittance.item() == pytest.approx(1)
    assert composite.accumulation.item() + composite.transmittance.item() == pytest.approx(1)
    assert (composite.weights >= 0).all()
    assert np.allclose(composite.weights[0], oracle.composite(taus).weights, atol=1e-14)


def test_compositing_has_the_gradient_of_finite_differences():
    rng = np.random.default_rng(12)
    tau = tensor(rng.exponential(0.5, (3, 6))).requires_grad_()
    skipped = tensor(np.cumsum(rng.exponential(0.1, (3, 6)), -1))
    valid = torch.tensor(rng.random((3, 6)) < 0.8)

    def composite(t):
        c = composite_weights.reference(t, valid, skipped, skipped[:, -1:] + 0.1)
        return c.weights, c.accumulation, c.transmittance

    assert torch.autograd.gradcheck(composite, (tau,))
    colors = tensor(rng.random((3, 6, 3))).requires_grad_()
    fixed = composite_weights.reference(tau.detach(), valid, skipped, skipped[:, -1:] + 0.1)
    assert torch.autograd.gradcheck(lambda c: render_colors(fixed, c), (colors,))
