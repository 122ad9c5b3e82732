"""Gradients of what rays show to where they start and where they go (field/mmpi_field.py), against float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hand_made import make_mpi, unit
from random_fields import OracleRay, bundle, fill, random_field, random_plan, random_rays

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import dispatch
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.rendering.rendered import render_rays
from mmpi_ns.scene.plan import ScenePlan

STEP = 1e-6
"""Of the finite differences, scene units."""
CLOSE = 3e-6
"""Rays on which a decision is closer than this have no derivative to compare with."""
MIX = np.array([0.9, -0.6, 1.3, 0.7])
"""Of red, green, blue and what passes: a ray as one number."""


def by_differences(field, origin, direction, near=0.05):
    """Central differences [6] of what the oracle renders; None where a sample comes or goes."""
    slopes, samples = [], None
    for axis in range(6):
        values = []
        for sign in (-1, 1):
            move = np.zeros(6)
            move[axis] = sign * STEP
            ray = OracleRay(field, origin + move[:3], direction + move[3:], near)
            met = [(s.head, s.plane) for head in ray.heads for s in head]
            if ray.margin < CLOSE or met != (samples or met):
                return None
            samples, actual = met, ray.render()
            values.append(MIX[:3] @ actual.color + MIX[3] * actual.transmittance)
        slopes.append((values[1] - values[0]) / (2 * STEP))
    return np.array(slopes)


def by_autograd(field, rays):
    """The same [R, 6] by the fast path."""
    o, d = rays.origins.requires_grad_(), rays.directions.requires_grad_()
    actual = render_rays(rays, field, MarchOptions(0.0))
    mix = torch.tensor(MIX).to(o)
    total = (actual.rgb @ mix[:3] + mix[3] * actual.composite.transmittance[:, 0]).sum()
    grads = torch.autograd.grad(total + 0 * (o + d).sum(), (o, d))  # also where no ray meets anything
    return torch.cat(grads, -1).double().numpy()


def compare(field, origins, directions, near=0.05):
    """How many rays had derivatives to compare with, of the size of their colours or so."""
    origins, directions = np.atleast_2d(origins), np.atleast_2d(directions)
    actual, compared = by_autograd(field, bundle(origins, directions, near)), 0
    assert np.isfinite(actual).all()
    for mine, origin, direction in zip(actual, origins, directions, strict=True):
        wanted = by_differences(field, np.float64(origin), np.float64(direction), near)
        if wanted is not None:
            assert np.abs(mine - wanted).max() < 5e-5 * (0.1 + np.abs(wanted).max())
            compared += np.abs(wanted).max() > 1e-2
    return compared


@pytest.mark.parametrize("ops", ["auto", "torch"])
@pytest.mark.parametrize("with_cube", [False, True])
def test_gradients_of_rays_are_finite_differences_of_the_oracle(ops, with_cube):
    field = random_field(2, with_cube, seed=3, log_depths=(-2.5, 0.0))
    with dispatch.chosen(ops):
        assert compare(field, *random_rays(field.plan, 10, seed=4)) >= 7


def one_mpi(log_depths=(-2.0, 0.3), far=np.inf, planes=4):
    mpi = make_mpi(planes=planes, far=far, extent=(-2.0, 2.0, -2.0, 2.0))
    return fill(MMPIField(ScenePlan((mpi,), None, 0.01, 1.0), feature_channels=5, hidden_width=6), 1, log_depths)


@pytest.mark.parametrize("depth", [1.0, 1.5, 3.0])
def test_a_camera_on_a_plane_has_the_gradients_of_one_beside_it(depth):
    direction = unit([0.2, 0.1, 1.0])
    beside, on = (np.array([0.13, 0.07, z]) for z in (depth + 1e-4, depth))
    assert compare(one_mpi(), beside, direction) == 1
    a, b = (by_autograd(one_mpi(), bundle([o], [direction])) for o in (beside, on))
    assert np.abs(a).max() > 0.01 and np.abs(a - b).max() < 1e-3


def test_opaque_planes_have_the_gradients_of_their_colours():
    """alpha = 1 in float32: what lies behind does not matter, and the slope of log(1 - alpha) is nowhere."""
    field = one_mpi(log_depths=(2.0, 3.0))
    assert compare(field, [0.13, 0.07, 0.0], unit([0.2, 0.1, 1.0])) == 1


def test_rays_along_the_planes_or_away_have_no_gradient():
    rays = bundle(np.zeros((3, 3)), [[1.0, 0, 0], [0.6, 0.8, 1e-7], [0, 0, -1.0]])
    assert not by_autograd(one_mpi(), rays).any()


def test_a_ray_nearly_along_the_planes_has_finite_gradients():
    actual = by_autograd(one_mpi(), bundle([[0, 0, 0]], [unit([1.9, 0.3, 1.0])]))
    assert np.isfinite(actual).all() and np.isfinite(by_autograd(one_mpi(), bundle([[0, 0, 0]], [[1, 0, 2e-6]]))).all()


def test_the_plane_at_infinity_moves_with_the_direction_alone():
    origin, direction = [0.13, 0.07, 5.0], unit([0.2, 0.1, 1.0])  # behind every plane but the last
    assert compare(one_mpi(), origin, direction) == 1
    actual = by_autograd(one_mpi(), bundle([origin], [direction]))
    assert not actual[0, :3].any() and np.abs(actual[0, 3:]).max() > 0.01
    finite = by_autograd(one_mpi(far=20.0), bundle([origin], [direction]))
    assert np.abs(finite[0, :3]).max() > 1e-4


@pytest.mark.parametrize("trains", [True, False])
def test_rays_shaded_once_have_the_gradients_of_float64_also_through_a_frozen_field(trains):
    plan, actual = random_plan(2, True, 0), []
    for dtype in (torch.float32, torch.float64):
        field = fill(MMPIField(plan, shading="ray", feature_channels=7, hidden_width=6), 0).to(dtype)
        field.requires_grad_(trains)
        rays = bundle(*random_rays(plan, 30, seed=5))
        for name in ("origins", "directions", "nears", "fars"):
            setattr(rays, name, getattr(rays, name).to(dtype))
        actual.append(by_autograd(field, rays))
    assert np.abs(actual[1]).max() > 0.1 and np.abs(actual[0] - actual[1]).max() < 1e-4 * np.abs(actual[1]).max()


def test_samples_stay_where_they_are_to_the_bit_and_rays_that_do_not_move_cost_nothing():
    field = random_field(2, True, seed=3)
    rays = bundle(*random_rays(field.plan, 20, seed=4))
    still = render_rays(rays, field, MarchOptions(0.0))
    rays.origins.requires_grad_()
    moving = render_rays(rays, field, MarchOptions(0.0))
    assert still.lookup is not None and moving.lookup is not None
    assert not still.lookup.ndc.requires_grad and moving.lookup.ndc.requires_grad
    assert torch.equal(still.lookup.ndc, moving.lookup.ndc) and still.lookup.ndc.std() > 0.1
