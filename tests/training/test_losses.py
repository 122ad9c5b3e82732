"""Each loss against a value worked out by hand, and its gradient (losses.py)."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hand_made import make_mpi, starts_of
from random_fields import random_plan
from training_runs import datamanager, plan_of, ready, trainer_config

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.composite import Composite
from mmpi_ns.ops.variation import clamped_differences
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.training import losses
from mmpi_ns.training.losses import depth_sums

F64 = torch.float64


def tensor(values, dtype=F64):
    return torch.tensor(np.asarray(values), dtype=dtype)


def sums_of(weights, inverse_t, intervals, targets, valid=None):
    """Depth sums of the samples [R, S] that there are."""
    valid = torch.ones_like(weights, dtype=torch.bool) if valid is None else valid
    return depth_sums(weights[valid], inverse_t[valid], starts_of(valid), intervals, targets, 1.0)


def distortion(weights, positions, intervals):
    """The loss of samples at positions in [0, 1]."""
    targets = weights.new_tensor([[0.0, 1.0]]).expand(len(weights), 2)
    return sums_of(weights, 1 / positions - 1, intervals, targets).spread.mean()


def keypoint_depth(weights, inverse_t, known, valid, relative_width=losses.KEYPOINT_WIDTH):
    targets = torch.cat([known, (relative_width * known).clamp(min=1e-12)], -1)
    sums = sums_of(weights, inverse_t, torch.ones_like(known[:, 0]), targets, valid)
    return losses.depth_priors(sums.mass, sums.reached, losses.KEYPOINT_OUTLIERS, sums.reached.sum().clamp(min=1))


def depth_priors(weights, inverse_t, known, valid, least_error, outliers=0.02):
    error = (known[:, 1:] ** 2 + least_error**2).sqrt().clamp(min=1e-12)
    targets = torch.cat([known[:, :1], error], -1)
    sums = sums_of(weights, inverse_t, torch.ones_like(known[:, 0]), targets, valid)
    return losses.depth_priors(sums.mass, sums.reached, outliers, max(1, len(sums.mass)))


def test_photometric_is_the_mean_squared_error():
    predicted, observed = tensor([[0.0, 0.5, 1.0], [1.0, 1.0, 1.0]]), tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    assert losses.photometric(predicted, observed).item() == pytest.approx((0.25 + 1 + 1) / 6)


def point_color(colors, weights, observed):
    """The loss from samples, through the sums that a ray keeps of them."""
    field = MMPIField(random_plan(1, False, 0), shading="sample")
    field.sample_colors = lambda *_: colors.flatten(0, 1)
    samples = SimpleNamespace(starts=torch.arange(len(weights) + 1) * weights.shape[1])
    composite = Composite(weights.flatten(), *[weights[:, :1]] * 3)
    _, sums = field.render_colors(None, samples, None, composite)
    return losses.point_color(sums.mass, sums.first, sums.second, observed)


def test_point_color_weighs_each_samples_error_by_its_weight():
    colors = tensor([[[1.0, 0.0, 0.0], [0.0, 0.0, 0.5]], [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]])
    weights = tensor([[0.5, 0.25], [0.0, 1.0]])
    observed = tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    # Ray 1: 0.5 * 1 + 0.25 * 0.25; ray 2: 1 * 1; mean over two rays.
    assert point_color(colors, weights, observed).item() == pytest.approx((0.5 + 0.0625 + 1.0) / 2)


def test_point_color_moves_colours_but_never_weights():
    colors, weights = torch.rand(2, 3, 3, requires_grad=True), torch.rand(2, 3, requires_grad=True)
    point_color(colors, weights, torch.rand(2, 3)).backward()
    assert weights.grad is None and colors.grad.abs().min() > 0


def test_background_entropy_is_largest_for_a_coin_flip_and_nothing_for_a_decision():
    assert losses.background_entropy(tensor([[0.5]])).item() == pytest.approx(math.log(2))
    quarter = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))
    assert losses.background_entropy(tensor([[0.25], [0.5]])).item() == pytest.approx((quarter + math.log(2)) / 2)
    assert losses.background_entropy(tensor([[0.0], [1.0]])).item() < 2e-5


def test_distortion_does_not_change_when_the_ray_is_moved():
    rng = np.random.default_rng(1)
    weights, positions = tensor(rng.random((2, 10))), tensor(np.sort(rng.random((2, 10)), -1) / 2)
    intervals = torch.zeros_like(weights[:, 0])
    here, there = (distortion(weights, positions + shift, intervals).item() for shift in (0.0, 0.5))
    assert here == pytest.approx(there)


def test_keypoint_depth_by_hand():
    # Known at 1/t = 2, width 0.1: samples at 0, 1 and 2 standard deviations (0.2 each), one far away.
    weights, inverse_t = tensor([[0.1, 0.4, 0.2, 0.3]]), tensor([[2.4, 2.2, 2.0, 0.5]])
    valid = torch.ones(1, 4, dtype=torch.bool)
    mass = 0.1 * math.exp(-2) + 0.4 * math.exp(-0.5) + 0.2
    loss = keypoint_depth(weights, inverse_t, tensor([[2.0]]), valid, relative_width=0.1)
    assert loss.item() == pytest.approx(-math.log(mass + 1e-4), abs=1e-9)


def test_keypoint_depth_leaves_out_rays_that_cannot_reach_their_point():
    weights = torch.full((4, 2), 0.5, dtype=F64)
    inverse_t = tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    valid = torch.tensor([[True, True], [True, True], [False, True], [True, True]])
    known = tensor([[1.0], [3.0], [1.0], [0.0]])  # reached, too near, sample in an empty slot, no point
    both = keypoint_depth(weights, inverse_t, known, valid)
    alone = keypoint_depth(weights[:1], inverse_t[:1], known[:1], valid[:1])
    assert both.item() == alone.item() == pytest.approx(-math.log(0.5 + 1e-4))
    none = keypoint_depth(weights[1:], inverse_t[1:], known[1:], valid[1:])
    assert none.item() == 0


def test_losses_have_the_gradient_of_finite_differences():
    rng = np.random.default_rng(5)
    weights, colors = (tensor(rng.random(s) + 0.05).requires_grad_() for s in ((3, 5), (3, 5, 3)))
    positions = tensor(np.sort(rng.random((3, 5)), -1))
    intervals, observed = tensor(rng.random(3)), tensor(rng.random((3, 3)))
    valid = torch.ones(3, 5, dtype=torch.bool)
    known, inverse_t = tensor([[1.0], [2.0], [0.0]]), tensor(1 + rng.random((3, 5)) * 0.2)
    transmittance = tensor([[0.2], [0.7], [0.5]]).requires_grad_()
    values, scales = tensor([[0.3], [2.5]]).requires_grad_(), tensor([[1.0, 0.5]] * 2)
    neighbours = tensor([[[0.1], [5.0]], [[0.0], [2.0]]])
    check = torch.autograd.gradcheck
    assert check(lambda c: losses.photometric(c[:, 0], observed), (colors,))
    assert check(lambda c: point_color(c, weights, observed), (colors,))
    assert check(losses.background_entropy, (transmittance,))
    assert check(lambda w: distortion(w, positions, intervals), (weights,))
    assert check(lambda w: keypoint_depth(w, inverse_t, known, valid, 0.1), (weights,))
    assert check(lambda v: clamped_differences(v, neighbours, scales), (values,))


def test_gradients_are_finite_for_empty_and_opaque_rays():
    weights = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], requires_grad=True)
    transmittance = torch.tensor([[1.0], [0.0], [0.0]], requires_grad=True)
    inverse_t = torch.tensor([[1e30, 1.0, 0.0], [5.0, 0.0, 0.0], [1.0, 1e-20, 0.0]])
    known = torch.tensor([[0.0], [5.0], [1e-20]])
    valid = torch.tensor([[True, True, False]] * 3)
    loss = (
        losses.background_entropy(transmittance)
        + distortion(weights, torch.tensor([[0.0, 0.5, 1.0]] * 3), torch.zeros(3))
        + keypoint_depth(weights, inverse_t, known, valid)
    )
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(weights.grad).all() and torch.isfinite(transmittance.grad).all()


def test_depth_priors_by_hand():
    # Known at 1/t = 2 with an error of 0.06, planes at least 0.08 uncertain: 0.1 in all; samples at 2, 1, 0 of it, far.
    weights, inverse_t = tensor([[0.1, 0.4, 0.2, 0.3]]), tensor([[2.2, 2.1, 2.0, 0.5]])
    valid = torch.ones(1, 4, dtype=torch.bool)
    mass = 0.1 * math.exp(-2) + 0.4 * math.exp(-0.5) + 0.2
    loss = depth_priors(weights, inverse_t, tensor([[2.0, 0.06]]), valid, least_error=0.08, outliers=0.05)
    assert loss.item() == pytest.approx(-math.log(mass + 0.05), abs=1e-9)


def test_a_depth_is_believed_as_its_error_says():
    """The same miss costs a certain depth more than an uncertain one, and planes too coarse to show it cost nothing."""
    weights, inverse_t, valid = tensor([[1.0]]), tensor([[1.1]]), torch.ones(1, 1, dtype=torch.bool)
    cost = [
        depth_priors(weights, inverse_t, tensor([[1.0, e]]), valid, least, 0.02).item()
        for e, least in ((0.05, 0.0), (0.2, 0.0), (0.05, 0.2))
    ]
    assert cost[0] > cost[1] > cost[2] and cost[2] == pytest.approx(0.1, abs=0.05)


def test_rays_without_a_depth_priors_or_out_of_its_reach_cost_nothing_and_count():
    weights, inverse_t = torch.full((4, 2), 0.5, dtype=F64), tensor([[1.0, 0.0]] * 4)
    valid = torch.tensor([[True, True], [True, True], [False, True], [True, True]])
    known = tensor([[1.0, 0.01], [3.0, 0.01], [1.0, 0.01], [0.0, 0.0]])  # reached, too near, empty slot, not known
    loss = depth_priors(weights, inverse_t, known, valid, 0.0, 0.02)
    assert loss.item() == pytest.approx(-math.log(0.5 + 0.02) / 4)


def test_a_false_depth_pulls_no_harder_than_the_share_of_outliers_allows():
    """Mass at 1/t = 2, a depth at 1 with next to no mass: the gradient is bounded by 1 / outliers."""
    weights = tensor([[0.999, 1e-9]]).requires_grad_()
    valid, known = torch.ones(1, 2, dtype=torch.bool), tensor([[1.0, 0.01]])
    pulls = []
    for outliers in (1e-4, 0.02, 0.2):
        (pull,) = torch.autograd.grad(depth_priors(weights, tensor([[2.0, 1.0]]), known, valid, 0.0, outliers), weights)
        pulls.append(-pull[0, 1].item())
    assert pulls == pytest.approx([1e4, 50, 5], rel=1e-4)


def test_a_depth_is_at_most_as_exact_as_planes_are_dense_also_of_an_mpi_that_ends(monkeypatch):
    plan = ScenePlan((make_mpi(near=1.0, far=1.25, planes=5),), None, 0.05, 1.0)  # planes 0.05 apart in 1 / depth
    monkeypatch.setattr(losses, "depth_sums", lambda *args: args[4])
    one = torch.ones(1, 1)
    samples = SimpleNamespace(num_intersected=one[0], inverse_t=one, starts=None)
    rays = SimpleNamespace(samples=samples, composite=SimpleNamespace(weights=one), rgb=one)
    bundle = SimpleNamespace(disparities=torch.tensor([[1.0, 0.0]]), keypoint_disparities=None)
    assert losses._depth_sums(rays, bundle, SimpleNamespace(plan=plan))[0, 1].item() == pytest.approx(0.6 * 0.05)


def test_depth_priors_has_the_gradient_of_finite_differences_and_a_finite_one_without_mass():
    rng = np.random.default_rng(6)
    weights = tensor(rng.random((3, 5)) + 0.05).requires_grad_()
    valid, known = torch.ones(3, 5, dtype=torch.bool), tensor([[1.0, 0.1], [1.2, 0.2], [0.0, 0.0]])
    inverse_t = tensor(1 + rng.random((3, 5)) * 0.2)
    assert torch.autograd.gradcheck(lambda w: depth_priors(w, inverse_t, known, valid, 0.05), (weights,))
    empty = torch.zeros(2, 3, requires_grad=True)
    bare = torch.tensor([[1e-20, 0.0], [5.0, 0.0]])
    depth_priors(
        empty, torch.tensor([[1e30, 0.0, 1e-20], [5.0, 5.0, 0.0]]), bare, torch.ones(2, 3, dtype=torch.bool), 0.0
    ).backward()
    assert empty.grad is not None and torch.isfinite(empty.grad).all()


def test_opaque_pixels_with_alpha_train_as_pixels_without(scene, tmp_path):
    """Also rays that their MPI sees in part: what it lets through is not its to explain, in any format."""
    plan = plan_of(datamanager(scene, test_mode="inference").observations)
    narrow = replace(plan, mpis=tuple(replace(m, extent=(-0.6, 0.2, -0.3, 0.3)) for m in plan.mpis))
    (tmp_path / "plan.json").write_text(narrow.to_json())
    trainer = ready(trainer_config(scene, tmp_path / "plan.json", tmp_path))
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    model.train()
    rays, batch = manager.next_train(0)
    outputs = model.get_outputs(rays)
    assert 0 < outputs["training"].samples.fully_covered.float().mean() < 1
    alpha = {**batch, "image": torch.cat([batch["image"], torch.ones(len(batch["image"]), 1)], -1)}
    plain, opaque = (model.get_loss_dict(outputs, b) for b in (batch, alpha))
    assert plain["rgb_loss"].item() == opaque["rgb_loss"].item() > 0
