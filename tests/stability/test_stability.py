"""Hard inputs come out within the roundings that float32 allows (docs/stability.md), and wrong code does not."""

from __future__ import annotations

import math

import pytest
import torch
from stability import blending as cases_blending
from stability import geometry as cases_geometry
from stability import merging as cases_merging
from stability import rays as cases_rays
from stability.cases import PRECISIONS, Error, compare
from stability.table import EVERY

from mmpi_ns import blending
from mmpi_ns.ops import composite
from mmpi_ns.scene import geometry

FLOAT32 = PRECISIONS[0]


def named(part, group):
    found = [c for c in group.cases() if part in c.inputs]
    assert len(found) == 1, [c.inputs for c in found]
    return found[0]


def failures(cases, precision=FLOAT32):
    return [c.inputs for c in cases if not c.measure(precision).holds]


@pytest.mark.parametrize("precision", PRECISIONS, ids=lambda p: p.name)
@pytest.mark.parametrize("case", EVERY, ids=lambda c: f"{c.group}: {c.inputs}")
def test_every_case_holds(case, precision):
    outcome = case.measure(precision)
    assert outcome.holds, f"{case.expectation}: {outcome}"


def test_compositing_in_half_precision_fails_its_cases(monkeypatch):
    """A kernel that rounds its optical depths to bfloat16 is wrong by 2^-9; every case of thin samples must see it."""
    right = composite.composite_weights

    def rounded(tau, *rest):
        return right(tau.bfloat16().float(), *rest)

    chosen = [c for c in cases_blending.cases() if c.group == "compositing" and "depths" in c.inputs]
    assert len(chosen) >= 3 and not failures(chosen)
    monkeypatch.setattr(cases_blending, "composite_weights", rounded)
    assert len(failures(chosen)) == len(chosen)


def test_a_transmittance_taken_from_alpha_fails_where_it_is_1e_minus_30(monkeypatch):
    def from_alpha(tau, valid, before, total):
        alpha = -torch.expm1(-tau)
        left = torch.cumprod(1 - alpha, -1)
        front = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], -1)
        return composite.Composite(front * alpha, 1 - left[:, -1:], left[:, -1:])

    chosen = [c for c in cases_blending.cases() if "1e-30" in c.inputs and c.group == "compositing"]
    assert len(chosen) == 3 and not failures(chosen)
    monkeypatch.setattr(cases_blending, "composite_weights", from_alpha)
    assert len(failures(chosen)) >= 2


def test_shares_from_log_softmax_alone_fail_where_reliability_is_saturated(monkeypatch):
    def plain(reliability, cover, own):
        share = torch.where(cover, reliability, -math.inf).log_softmax(-1).gather(1, own[:, None])[:, 0]
        return share, torch.log1p(-share.exp())

    case = named("12 MPIs, reliabilities +-1000, tau 0 to 1e4", cases_blending)
    assert case.measure(FLOAT32).holds
    monkeypatch.setattr(cases_blending, "blend_shares", plain)
    assert not case.measure(FLOAT32).holds


@pytest.mark.parametrize("inputs", ["12 random MPIs, 200 rays", "1e6 units from the world's origin"])
def test_geometry_by_matrix_products_fails_under_autocast_and_by_single_products_holds(monkeypatch, inputs):
    case = next(c for c in cases_geometry.cases() if inputs in c.inputs)
    assert all(case.measure(p).holds for p in PRECISIONS)
    monkeypatch.setattr(geometry, "rotate", lambda axes, v: (axes @ v[..., None])[..., 0])
    assert case.measure(FLOAT32).holds and not case.measure(PRECISIONS[1]).holds


def test_a_live_range_that_is_one_plane_short_is_counted(monkeypatch):
    right = cases_geometry.plane_hits

    def short(*args):
        hits = right(*args)
        return type(hits)(hits.m_first, (hits.count - 1).clamp(min=0), hits.u, hits.v, hits.local_origins,
                          hits.local_directions)  # fmt: skip

    monkeypatch.setattr(cases_geometry, "plane_hits", short)
    outcome = named("12 random MPIs, 200 rays", cases_geometry).measure(FLOAT32)
    assert outcome.value.error > 100 and outcome.value.bound == 0


def test_an_unstable_sort_fails_the_ties(monkeypatch):
    case = named("nearly all tie", cases_merging)
    assert case.measure(FLOAT32).holds
    right = torch.sort

    def last_comes_first(keys, **how):
        values, order = right(keys.flip(-1), **how)
        return values, keys.shape[-1] - 1 - order

    monkeypatch.setattr(torch, "sort", last_comes_first)
    assert not case.measure(FLOAT32).holds


def test_a_whole_ray_with_a_wrong_gradient_fails(monkeypatch):
    """Colours are right, but the reliability's gradient is 0.1 % too large."""
    case = named("4 MPIs, blended", cases_rays)
    assert case.measure(FLOAT32).holds

    class Scaled(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, grad):
            return 1.001 * grad

    right = blending.blend_shares
    monkeypatch.setattr("mmpi_ns.blending.blend_shares", lambda r, *rest: right(Scaled.apply(r), *rest))
    outcome = case.measure(FLOAT32)
    assert outcome.value.holds and not outcome.gradient.holds


def test_results_that_are_not_finite_fail():
    assert not compare(torch.tensor([math.nan]), [0.0], 1.0, 4).holds
    assert not compare(torch.tensor([math.inf]), [1.0], math.inf, 4).holds
    assert Error.worst([Error(0.1, 1.0), Error(math.inf, 1.0)]).error == math.inf
    assert Error.worst([Error(0.1, 1.0), Error(1e-7, 1e-8)]).bound == 1e-8
