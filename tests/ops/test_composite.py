"""Merged transmittance, sample by sample, and what a ray gathers (ops/composite)."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from hand_made import tensor

from mmpi_ns.ops.composite import composite_weights, exclusive_cumsum, median_inverse_distance, render_colors


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


def test_alpha_one_everywhere_stops_at_the_first_sample():
    composite = composite_all(torch.full((2, 50), 1e4))
    assert composite.weights[:, 0].tolist() == [1.0, 1.0] and composite.weights[:, 1:].abs().sum() == 0
    assert composite.accumulation.tolist() == [[1.0]] * 2 and composite.transmittance.tolist() == [[0.0]] * 2


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
