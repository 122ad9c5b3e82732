"""Compiled operations and plain torch are compared on a small batch before a training relies on them."""

from __future__ import annotations

import torch
from random_fields import bundle, random_field, random_rays
from training_runs import ready, trainer_config

from mmpi_ns.ops import composite, dispatch
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.rendering import rendered
from mmpi_ns.training import losses as of_batches
from mmpi_ns.training.agreement import disagreement


def a_batch():
    field = random_field(3, seed=1)
    for parameter in field.parameters():
        parameter.requires_grad_(True)
    return field, bundle(*random_rays(field.plan, 200, seed=1))


def losses(rays):
    return {"accumulation": rays.composite.accumulation.mean()}


def test_the_forms_of_this_machine_agree_and_leave_no_gradient():
    field, rays = a_batch()
    assert dispatch.form_of("march", torch.zeros(1)) == "cpu"
    assert disagreement(field, rays, MarchOptions(1e-3), losses) == ""
    assert all(parameter.grad is None for parameter in field.parameters())


def test_a_form_that_computes_something_else_is_named(monkeypatch):
    field, rays = a_batch()
    right = composite.composite_weights

    def wrong(tau, *others):
        return right(tau if dispatch._chosen == "torch" else 1.1 * tau, *others)

    monkeypatch.setattr(rendered, "composite_weights", wrong)
    actual = disagreement(field, rays, MarchOptions(1e-3), losses)
    assert all(name in actual for name in ("gradients of density", "colours", "losses"))


def test_a_run_compares_its_losses_too(scene, plan_file, tmp_path, monkeypatch):
    trainer = ready(trainer_config(scene, plan_file, tmp_path))
    trainer.pipeline.train()
    trainer.pipeline.datamanager.next_train(0)
    assert trainer.kernels_differ() == ""
    right = of_batches.depth_sums
    factor = {"torch": 1.0, "auto": 4.0}

    def wrong(weights, *others):
        return right(factor[dispatch._chosen] * weights, *others)

    monkeypatch.setattr(of_batches, "depth_sums", wrong)
    actual = trainer.kernels_differ()
    assert "losses" in actual and "gradients of" in actual and "colours" not in actual
