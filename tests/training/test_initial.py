"""Initial surfaces: votes of rays with known depth against loops in float64, and what densities and colours follow."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from hand_made import make_mpi
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from random_fields import random_plan, random_rays
from training_runs import ready, trainer_config

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.training.initial import DARKEST, EMPTY_FROM, PLANE_ERROR, PRIOR, Votes, start_from_votes

TOO_CLOSE = 1e-4
"""Relative margin of a decision within which single and double precision may differ."""


def field_of(plan, **options):
    return MMPIField(plan, shading="ray", feature_channels=8, shares_depth=True, **options)


def votes_of(field, origins, directions, depths, colors):
    votes = Votes(*(torch.zeros(len(field.density), *more) for more in ((), (), (3,))))
    parts = (torch.tensor(np.asarray(x), dtype=torch.float32) for x in (origins, directions, depths, colors))
    votes.add(field.layout, *parts, field.plan.ray_near)
    return votes


def slow_votes(plan, origins, directions, depths, colors):
    """{(head, plane, y, x): [surface, empty, color sums]} by loops; None in the place of anything too close to call."""
    out, unsure = {}, set()
    for origin, direction, (inverse, error), color in zip(origins, directions, depths, colors, strict=True):
        for k, mpi in enumerate(plan.mpis):
            actual, (u0, u1, v0, v1) = oracle.crossings(mpi, origin, direction, plan.ray_near), mpi.extent
            o, d, _ = oracle.in_frame(mpi, origin, direction)
            w = oracle.disparities(mpi)
            # The next plane's inverse distance, from the slope of 1/t = w d / (1 - w o) over the disparity w of planes.
            spacings = (w[0] - w[1]) * np.abs(d[2]) / (1 - w * o[2]) ** 2
            for plane in np.flatnonzero(actual.intersected | (actual.margin <= TOO_CLOSE)).tolist():
                x, y = (actual.u[plane] - u0) / (u1 - u0), (actual.v[plane] - v0) / (v1 - v0)
                x, y, spacing = x * (mpi.width - 1), y * (mpi.height - 1), spacings[plane]
                width = max(error, PLANE_ERROR * spacing)
                before, margin = (actual.inverse_t[plane] - inverse) / width, actual.margin[plane]
                near = min(abs(abs(before) - 1), abs(before - EMPTY_FROM), abs(x % 1 - 0.5), abs(y % 1 - 0.5), margin)
                if near < TOO_CLOSE or abs(1 - w[plane] * o[2]) < 2e-3:
                    unsure.update((k, plane, b, a) for b in _near(y, mpi.height) for a in _near(x, mpi.width))
                    continue
                texel = (k, plane, round(np.clip(y, 0, mpi.height - 1)), round(np.clip(x, 0, mpi.width - 1)))
                entry = out.setdefault(texel, np.zeros(5))
                if abs(before) <= 1:
                    share = min(1.0, spacing / width)
                    entry[0] += share
                    entry[2:] += share * np.asarray(color)
                elif before > EMPTY_FROM:
                    entry[1] += 1
    return out, unsure


def _near(x, size):
    return {min(max(math.floor(x) + i, 0), size - 1) for i in (-1, 0, 1, 2)}


@pytest.mark.parametrize(("mpis", "seed"), [(1, 0), (3, 1), (4, 2)])
def test_votes_are_those_of_loops_over_rays_and_planes(mpis, seed):
    plan, rng = random_plan(mpis, mpis == 3, seed), np.random.default_rng(seed)
    field = field_of(plan)
    origins, directions = random_rays(plan, 60, seed)
    depths = np.stack([10 ** rng.uniform(-2, 0.3, 60), 10 ** rng.uniform(-3, -0.5, 60)], -1)
    colors = rng.uniform(size=(60, 3))
    votes = votes_of(field, origins, directions, depths, colors)
    slow, unsure = slow_votes(plan, origins, directions, depths, colors)
    compared = 0
    for k in range(mpis):
        grid = field.grids[k]
        shape = grid.depth, grid.height, grid.width
        surface, empty = votes.surface[grid.rows].view(shape), votes.empty[grid.rows].view(shape)
        sums = votes.colors[grid.rows].view(*shape, 3)
        for plane, y, x in np.ndindex(*shape):
            if (k, plane, y, x) in unsure:
                continue
            expected = slow.get((k, plane, y, x), np.zeros(5))
            got = [surface[plane, y, x], empty[plane, y, x], *sums[plane, y, x]]
            np.testing.assert_allclose(np.array(got), expected, rtol=1e-3, atol=1e-5)
            compared += expected.any()
    assert compared > 100


def straight(planes=9, **size):
    """A field of one MPI that faces along z, and rays along its axis with a surface at depth 2."""
    plan = ScenePlan((make_mpi(extent=(-1.0, 1.0, -1.0, 1.0), planes=planes, **size),), None, 0.05, 1.0)
    return field_of(plan), [[0.0, 0.0, 0.0]] * 500, [[0.0, 0.0, 1.0]] * 500, [[0.5, 1e-4]] * 500


def alphas(field):
    """Of every plane, at the texel in the middle."""
    grid = field.grids[0]
    rows = grid.row(torch.arange(grid.depth), torch.tensor(grid.height // 2), torch.tensor(grid.width // 2))
    raw = field.density.data[rows, 0]
    tau = field.layout.optical_depth(0, raw, torch.arange(grid.depth))
    return -torch.expm1(-tau), rows


def test_planes_before_a_surface_are_empty_the_surface_is_dense_and_what_lies_behind_is_as_before():
    field, *rays = straight(width=9, height=9)
    before, rows = alphas(field)
    start_from_votes(field, votes_of(field, *rays, [[0.9, 0.5, 0.1]] * 500))
    after, _ = alphas(field)
    surface = int(np.abs(oracle.disparities(field.plan.mpis[0]) - 0.5).argmin())
    assert (after[: surface - 1] < 0.2 * before[: surface - 1]).all()
    assert after[surface - 1] == before[surface - 1], "within two errors of the surface: no vote"
    assert after[surface].item() == pytest.approx((500 + PRIOR * before[surface].item()) / (500 + PRIOR), rel=1e-3)
    assert torch.equal(after[surface + 1 :], before[surface + 1 :])
    rendered = field.features.data[rows[surface], :3].sigmoid()
    assert torch.allclose(rendered, torch.tensor([0.9, 0.5, 0.1]), atol=1e-4)
    assert not field.features.data[rows[:surface]].any()


def test_black_and_white_surfaces_keep_a_logit_that_can_move():
    field, *rays = straight(width=9, height=9)
    start_from_votes(field, votes_of(field, *rays, [[0.0, 1.0, 0.0]] * 500))
    assert field.features.data[:, :3].abs().max().item() == pytest.approx(math.log((1 - DARKEST) / DARKEST), rel=1e-4)


@pytest.mark.parametrize(("mpis", "planes"), [(1, 2), (1, 64), (1, 256), (64, 2), (64, 64)])
def test_densities_stay_finite_for_any_number_of_planes_and_mpis(mpis, planes):
    many = tuple(
        make_mpi(f"m{k}", extent=(-1.0, 1.0, -1.0, 1.0), planes=planes, width=8, height=8) for k in range(mpis)
    )
    field = field_of(ScenePlan(many, None, 0.05, 1.0))
    rays = [[0.0, 0.0, 0.0]] * 40, [[0.0, 0.0, 1.0]] * 40
    for inverse, error in ((0.0, 1e-9), (1e-6, 1e-9), (0.3, 10.0), (1e4, 1e-3)):  # at infinity, unsure, at the camera
        start_from_votes(field, votes_of(field, *rays, [[inverse, error]] * 40, [[0.5] * 3] * 40))
        assert torch.isfinite(field.density.data).all()
        assert torch.isfinite(field.features.data).all()


def prepared(scene, plan_file, folder, steps, **settings):
    """The field of a run after the callbacks before each of these steps."""
    config = trainer_config(scene, plan_file, folder, 60)
    for name, value in settings.items():
        setattr(config.pipeline.datamanager.priors, name, value)
    trainer = ready(config)
    for step in steps:
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    return trainer.pipeline.model.field


def test_a_run_starts_from_the_depths_of_its_pixels_once(scene, plan_file, tmp_path):
    field = prepared(scene, plan_file, tmp_path / "a", [0])
    changed = (field.density.data != 0).any(-1)
    assert changed.any() and (field.features.data[:, :3] != 0).any()
    assert not field.features.data[:, 3:].any(), "view dependence is learned"
    again = prepared(scene, plan_file, tmp_path / "b", [0, 1])
    assert torch.equal(field.density.data, again.density.data)
    later = prepared(scene, plan_file, tmp_path / "c", [1])
    assert not later.density.data[BRICK:].any(), "a run that goes on has surfaces already"


def test_without_depth_priors_every_plane_starts_alike(scene, plan_file, tmp_path):
    field = prepared(scene, plan_file, tmp_path, [0], dense_depth=False, depth_images=False, sfm_path="none")
    assert not field.density.data[BRICK:].any() and not field.features.data.any()
