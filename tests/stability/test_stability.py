"""Hard inputs come out within the roundings that float32 allows (docs/stability.md), and wrong code does not."""

from __future__ import annotations

import pytest
import torch
from stability import blending as cases_blending
from stability import rays as cases_rays
from stability.cases import PRECISIONS
from stability.table import EVERY

from mmpi_ns import blending
from mmpi_ns.ops import composite

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
