"""Shares of the heads and what they leave of a sample's optical depth (blending.py, paper sec. III-C)."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from bricked import bricked_field, chance
from compiled import both, compiled  # noqa: F401
from hand_made import random_votes, tensor
from marches import hard_rays
from random_fields import random_rays
from random_scenes import dense_grad

from mmpi_ns.blending import blend_shares, blended_optical_depth, log_shares
from mmpi_ns.ops.composite import composite_weights
from mmpi_ns.ops.interpolate import Table

F64 = torch.float64


def shares_of(votes, dtype=F64):
    reliability, cover, own = votes
    return blend_shares(tensor(reliability, dtype), torch.tensor(cover), torch.tensor(own))


def composite_all(tau):
    """Of one ray."""
    return composite_weights(tau, torch.tensor([0, len(tau)]), torch.zeros_like(tau), tau.new_zeros(1, 1))


# Shares --------------------------------------------------------------------------------------------------------------


def test_shares_of_two_heads_are_the_logistic_function():
    votes = ([[1.0, -1.0], [1.0, -1.0]], [[True, True]] * 2, [0, 1])
    log_share, log_rest = shares_of(votes)
    p = 1 / (1 + math.exp(-2))
    assert log_share.exp().tolist() == pytest.approx([p, 1 - p], rel=1e-14)
    assert log_rest.exp().tolist() == pytest.approx([1 - p, p], rel=1e-14)


@pytest.mark.parametrize("heads", [2, 3, 12])
def test_heads_that_tie_share_equally(heads):
    votes = (np.full((heads, heads), 7.25), np.ones((heads, heads), bool), np.arange(heads))
    log_share, log_rest = shares_of(votes)
    assert log_share.exp().tolist() == pytest.approx([1 / heads] * heads)
    assert log_rest.exp().tolist() == pytest.approx([1 - 1 / heads] * heads)


# Log shares are differences of numbers as large as R, so their absolute error is a few ulps of the largest |R|.
@pytest.mark.parametrize("scale", [1.0, 30.0, 1e3])
@pytest.mark.parametrize("heads", [1, 2, 12])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_shares_equal_the_oracle_at_every_reliability(heads, scale, dtype):
    votes = random_votes(np.random.default_rng(heads), 200, heads, scale)
    reliability = tensor(votes[0], dtype).double().numpy()  # compare with what this precision was given
    wanted = np.array([oracle.log_shares(r, c, o) for r, c, o in zip(reliability, *votes[1:], strict=True)])
    actual = torch.stack(shares_of(votes, dtype), -1).double().numpy()
    sole = np.isneginf(wanted[:, 1])
    assert np.array_equal(np.isneginf(actual[:, 1]), sole) and np.all(actual[sole, 0] == 0)
    ulp = torch.finfo(dtype).eps * max(4.0, np.abs(reliability).max())
    assert np.abs(actual[~sole] - wanted[~sole]).max(initial=0) < 2 * ulp


def test_what_uncovered_heads_hold_is_ignored():
    cover, own = torch.tensor([[True, False, True, False]]), torch.tensor([2])
    clean = blend_shares(tensor([[0.5, 0.0, 1.5, 0.0]]), cover, own)
    for junk in (1e30, -math.inf, math.inf, math.nan):
        reliability = tensor([[0.5, junk, 1.5, junk]]).requires_grad_()
        dirty = blend_shares(reliability, cover, own)
        assert torch.equal(clean[0], dirty[0].detach()) and torch.equal(clean[1], dirty[1].detach())
        (dirty[0].sum() + dirty[1].sum()).backward()
        assert reliability.grad[0, 1] == 0 and reliability.grad[0, 3] == 0
        assert torch.isfinite(reliability.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_sole_cover_keeps_its_optical_depth_exactly(dtype):
    tau = torch.tensor([0.0, 1e-30, 1e-7, 0.1, 3.0, 88.0, 1e4], dtype=dtype)
    own = torch.arange(7) % 3
    cover = torch.nn.functional.one_hot(own, 3).bool()
    reliability = torch.linspace(-1e3, 1e3, 21, dtype=dtype).view(7, 3)
    log_share, log_rest = blend_shares(reliability, cover, own)
    assert log_share.tolist() == [0.0] * 7 and log_rest.tolist() == [-math.inf] * 7
    assert torch.equal(blended_optical_depth(tau, log_share, log_rest), tau)


def test_sole_cover_sends_all_gradient_to_its_depth_and_none_to_its_reliability():
    reliability = torch.full((2, 3), 4.0, requires_grad=True)
    tau = torch.tensor([0.5, 1e4], requires_grad=True)
    shares = blend_shares(reliability, torch.tensor([[True, False, False]] * 2), torch.tensor([0, 0]))
    blended_optical_depth(tau, *shares).sum().backward()
    assert tau.grad.tolist() == [1.0, 1.0]
    assert reliability.grad.tolist() == [[0.0] * 3] * 2


@pytest.mark.parametrize("count", [0, 1, 4000])
def test_shares_of_samples_and_their_gradients_are_those_of_plain_torch(three_threads, count):
    """Heads of several shapes, in which some texels are not stored and others not trained, and samples anywhere on
    ordinary and hard rays: outside of their head, behind others, at infinity."""
    field = bricked_field()
    field.touched[chance(len(field.touched), 0.3)] = 0
    rays = np.concatenate([random_rays(field.plan, 190, seed=1), (hard_rays().origins, hard_rays().directions)], 1)
    origins, directions = tensor(np.tile(rays, (1, 20, 1))[:, :count], torch.float32)
    inverse_t = tensor((np.random.default_rng(2).exponential(size=count) - 0.1).clip(0), torch.float32)
    heads = torch.arange(count) % field.layout.num_heads

    def shares():
        table = Table(field.reliability.data)
        tables = field.tables._replace(reliability=table)
        log_share, log_rest = log_shares(field.layout, tables, origins, directions, inverse_t, heads)
        (log_share + 2 * log_rest.clamp(min=-50)).sum().backward()
        return log_share.detach(), log_rest.detach(), dense_grad(table)

    for fast, plain in zip(*both(shares), strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-5, atol=1e-4)


# Blended optical depth -----------------------------------------------------------------------------------------------


def test_blending_scales_alpha():
    tau, share = tensor([0.7]), tensor([0.25])
    alpha = 1 - math.exp(-0.7)
    blended = blended_optical_depth(tau, share.log(), (1 - share).log())
    assert 1 - math.exp(-blended.item()) == pytest.approx(0.25 * alpha)


@pytest.mark.parametrize("heads", [2, 4])
def test_opaque_copies_that_share_equally_leak(heads):
    votes = (np.zeros((heads, heads)), np.ones((heads, heads), bool), np.arange(heads))
    tau = blended_optical_depth(torch.full((heads,), 1e4, dtype=F64), *shares_of(votes))
    leak = (1 - 1 / heads) ** heads
    assert composite_all(tau).transmittance.item() == pytest.approx(leak, abs=1e-12)


def test_blended_depth_never_exceeds_depth_and_is_never_negative():
    rng = np.random.default_rng(9)
    votes = random_votes(rng, 4000, 5, 20.0)
    tau = tensor(10 ** rng.uniform(-8, 4, size=4000), torch.float32)
    blended = blended_optical_depth(tau, *shares_of(votes, torch.float32))
    assert (blended >= 0).all() and (blended <= tau * (1 + 1e-6) + 2e-5).all()


@pytest.mark.parametrize("level", [-1e3, 0.0, 30.0, 1e3])
def test_empty_samples_stay_empty_at_any_level_of_reliability_in_float32(level):
    """Only differences of reliabilities matter. A thousand empty samples a ray must not add up to a veil."""
    reliability, cover, own = random_votes(np.random.default_rng(1), 2000, 3, 1.0)
    shares = shares_of((reliability + level, cover, own), torch.float32)
    assert blended_optical_depth(torch.zeros(2000), *shares).max() < 5e-7


# Gradients -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gap", [-80.0, -30.0, -10.0, 10.0, 30.0, 80.0])
def test_small_gradients_of_reliability_are_right_in_float32(gap):
    """Where P is near 0 or 1 the slopes P (1 - P) are tiny; Adam makes full steps of them, so signs must be true."""
    for tau in (1e-3, 1.0, 30.0):
        reliability = torch.tensor([[gap, 0.0]], requires_grad=True)
        shares = blend_shares(reliability, torch.ones(1, 2, dtype=torch.bool), torch.tensor([0]))
        blended_optical_depth(torch.tensor([tau]), *shares).sum().backward()
        h, either = 1e-3, np.ones(2, bool)
        above, below = (oracle.blend(tau, [gap + s, 0.0], either, 0).depth for s in (h, -h))
        assert reliability.grad[0].tolist() == pytest.approx(
            [(above - below) / 2 / h, -(above - below) / 2 / h], rel=1e-4
        )


def test_reliability_learns_in_the_direction_that_helps():
    """Own head opaque, other head empty: raising the own reliability raises the weight, by w's derivative P (1 - P)."""
    reliability = tensor([[0.3, -0.2]]).requires_grad_()
    shares = blend_shares(reliability, torch.tensor([[True, True]]), torch.tensor([0]))
    tau = blended_optical_depth(tensor([1e4]), *shares)
    composite_all(tau).weights.sum().backward()
    p = 1 / (1 + math.exp(-0.5))
    assert reliability.grad[0].tolist() == pytest.approx([p * (1 - p), -p * (1 - p)])
