"""Compiled operations and plain torch are compared on a small batch before a training relies on them."""

from __future__ import annotations

import torch
from random_fields import bundle, random_field, random_rays

from mmpi_ns.ops import composite, dispatch
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.rendering import rendered
from mmpi_ns.training.agreement import disagreement


def a_batch():
    field = random_field(3, seed=1)
    for parameter in field.parameters():
        parameter.requires_grad_(True)
    return field, bundle(*random_rays(field.plan, 200, seed=1))


def test_the_forms_of_this_machine_agree_and_leave_no_gradient():
    field, rays = a_batch()
    assert dispatch.form_of("march", torch.zeros(1)) == "cpu"
    assert disagreement(field, rays, MarchOptions(1e-3)) == ""
    assert all(parameter.grad is None for parameter in field.parameters())


def test_a_form_that_computes_something_else_is_named(monkeypatch):
    field, rays = a_batch()
    right = composite.composite_weights

    def wrong(tau, *others):
        return right(tau if dispatch._chosen == "torch" else 1.1 * tau, *others)

    monkeypatch.setattr(rendered, "composite_weights", wrong)
    actual = disagreement(field, rays, MarchOptions(1e-3))
    assert "gradients of density" in actual and "colours" in actual
