"""The oracle on rays worked out by hand; sampler, field and compositing together against it, and what the sampler
promises about its samples."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace

import numpy as np
import oracle
import pytest
import torch
from hand_made import IDENTITY, make_mpi, unit
from random_fields import bundle, compare, fill, random_field, random_rays, render

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import dispatch
from mmpi_ns.scene.plan import CubePlan, ScenePlan


def test_oracle_crosses_planes_where_geometry_says():
    mpi = make_mpi(near=1.0, planes=3, extent=(-1.2, 1.2, -1.0, 1.0))  # depths 1, 2, infinity
    actual = oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8])
    assert actual.intersected.tolist() == [False, True, True]
    assert actual.u.tolist() == pytest.approx([1.5, 1.125, 0.75])
    assert actual.inverse_t.tolist() == pytest.approx([1 / 2.5, 1 / 3.75, 0])
    assert oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8], far=4.0).intersected.tolist() == [False, True, False]
    assert oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8], near=3.8).intersected.tolist() == [False, False, True]


def test_oracle_renders_two_planes_by_hand():
    near, far = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    both = np.ones(2, bool)
    samples = [
        [oracle.RaySample(0, 0, 0.5, math.log(2), near, np.array([0.0, 0.0]), both)],
        [oracle.RaySample(1, 0, 1.0, math.log(4), far, np.array([0.0, math.log(3)]), both)],
    ]
    ray = oracle.render_ray(samples)
    # The second head is nearer: alpha' = 3/4 * 3/4; then alpha' = 1/2 * 1/2.
    assert ray.weights.tolist() == pytest.approx([9 / 16, 7 / 16 / 4])
    assert ray.color.tolist() == pytest.approx([7 / 64, 9 / 16, 0])
    assert ray.transmittance == pytest.approx(21 / 64) and ray.median_inverse_distance == 1.0
    assert oracle.render_ray(samples, False).transmittance == pytest.approx(1 / 8)


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize("with_cube", [False, True])
@pytest.mark.parametrize(("num_mpis", "rays"), [(1, 24), (4, 12), (12, 5)])
def test_with_threshold_0_rays_look_as_the_oracle_says(num_mpis, rays, with_cube, blends):
    field = random_field(num_mpis, with_cube, seed=num_mpis)
    assert compare(field, *random_rays(field.plan, rays, seed=5), blends) >= 0.6 * rays


def test_texels_that_no_ray_trained_do_not_vote():
    field = random_field(4, True, seed=4)
    rays = random_rays(field.plan, 10, seed=6)
    everyone = render(field, bundle(*rays), blends=True).composite.weights
    field.touched[torch.rand(len(field.touched), generator=torch.Generator().manual_seed(0)) < 0.6] = 0
    assert compare(field, *rays, True) >= 5
    assert (render(field, bundle(*rays), blends=True).composite.weights - everyone).abs().max() > 0.01


@pytest.mark.parametrize("with_cube", [False, True])
def test_a_head_mask_leaves_only_the_heads_it_names(with_cube):
    field = random_field(4, with_cube, seed=8)
    mask = torch.rand(12, field.plan.num_heads, generator=torch.Generator().manual_seed(1)) < 0.5
    origins, directions = random_rays(field.plan, 12, seed=7)
    named = [set(row.nonzero()[:, 0].tolist()) for row in mask]
    assert compare(field, origins, directions, None, lambda i, _: named[i], head_mask=mask) >= 3


def test_each_ray_goes_to_its_first_choice_among_the_mpis_that_it_meets_and_to_the_cube():
    field = random_field(4, True, seed=9)
    origins, directions = random_rays(field.plan, 16, seed=9)
    choose = torch.rand(16, 4, generator=torch.Generator().manual_seed(2))
    second_choices = []

    def heads_of(i, ray):
        order = choose[i].argsort(descending=True).tolist()
        meets = [k for k in order if ray.heads[k]]
        second_choices.append(bool(meets) and meets[0] != order[0])
        return {*meets[:1], 4}

    assert compare(field, origins, directions, None, heads_of, choose=choose) >= 9
    assert any(second_choices), "no ray misses its first choice"


@pytest.mark.parametrize("blends", [True, False])
def test_samples_of_two_identical_mpis_tie_and_the_first_mpi_comes_first(blends):
    twin = make_mpi("a", (0.3, 0.1, -0.2), IDENTITY), make_mpi("b", (0.3, 0.1, -0.2), IDENTITY)
    field = fill(MMPIField(ScenePlan(twin, None, 0.05, 1.0), feature_channels=5, hidden_width=6), seed=1)
    assert compare(field, *random_rays(field.plan, 10, seed=3), blends) >= 8
    samples = render(field, bundle([[0, 0, 0]], [[0, 0, 1]]), blends=blends).samples
    assert samples.heads.tolist() == [0, 1] * 9
    assert (samples.inverse_t[::2] == samples.inverse_t[1::2]).all()


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize("threshold", [1e-3, 1e-2, 0.3])
def test_dropping_samples_changes_a_ray_by_no_more_than_the_dropped_mass(threshold, blends):
    field = random_field(4, True, seed=10, planes=40)
    rays = bundle(*random_rays(field.plan, 64, seed=11))
    whole, part = render(field, rays, 0.0, blends), render(field, rays, threshold, blends)
    dropped = part.samples.dropped_mass
    assert ((part.rgb - whole.rgb).abs() <= dropped + 1e-5).all()
    assert ((part.composite.accumulation - whole.composite.accumulation).abs() <= 1e-5).all()
    assert (dropped > 1e-4).any() and whole.samples.dropped_mass.max() == 0
    assert torch.equal(part.samples.num_intersected, whole.samples.num_intersected)
    assert 0 < len(part.samples.heads) < len(whole.samples.heads)
    assert torch.allclose(whole.composite.mass - part.composite.mass, dropped, atol=2e-5)


def test_with_a_fair_share_nothing_is_dropped_at_the_start_where_all_weights_are_equal():
    plan = ScenePlan((make_mpi(planes=64),), None, 0.05, 1.0)
    actual = render(MMPIField(plan).eval(), bundle([[0, 0, 0]], [[0, 0, 1]]), threshold=0.5, fair_share=0.1)
    assert actual.samples.starts.tolist() == [0, 64]
    assert torch.allclose(actual.composite.weights, torch.tensor(1 / 64), rtol=0.01)


@pytest.mark.parametrize("blends", [True, False])
def test_rays_that_meet_nothing_are_empty(plan, blends):
    """Away from every head, alone in a batch, beside a ray that meets planes, and in a batch of no rays."""
    field = fill(MMPIField(plan), seed=0)
    backwards, forwards = [0.0, 0, -1], [0.0, 0, 1]
    for directions in ([backwards], [backwards, forwards], np.zeros((0, 3))):
        actual = render(field, bundle(np.zeros((len(directions), 3)), directions), blends=blends)
        count = len(directions)
        assert actual.rgb.shape == (count, 3) and len(actual.samples.starts) == count + 1
        assert torch.isfinite(actual.rgb).all()
        if count:
            assert (actual.rgb[0] == 0).all() and actual.composite.transmittance[0] == 1
            assert actual.samples.num_intersected[0] == 0 and not actual.samples.fully_covered[0]
            assert actual.samples.starts[1] == 0
        if count == 2:
            assert actual.composite.transmittance[1] < 0.5


@pytest.mark.parametrize(("near", "far"), [(0.05, 9.1), (5.1, math.inf), (3.1, 12.3)])
def test_samples_lie_between_near_and_far(near, far):
    field = random_field(4, True, seed=12)
    origins, directions = random_rays(field.plan, 12, seed=13)
    assert compare(field, origins, directions, True, near=near, far=far) >= 4
    samples = render(field, bundle(origins, directions, near, far)).samples
    t = 1 / samples.inverse_t
    assert t.min() >= near * (1 - 1e-5) and t.max() <= far * (1 + 1e-5)


def test_the_plane_at_infinity_is_sampled_where_the_ray_points_and_not_where_it_starts():
    field = fill(MMPIField(ScenePlan((make_mpi(),), None, 0.05, 1.0), feature_channels=5, hidden_width=6), seed=2)
    direction = unit([0.3, -0.2, 1.0])
    origins = np.array([[0, 0, 0], [0.2, 0.1, 500.0]])
    actual = render(field, bundle(origins, [direction, direction]))
    last = actual.samples.starts[1:] - 1
    assert last[1] == last[0] + 1, "beyond all finite planes only infinity is left"
    for i in last:
        assert actual.samples.planes[i] == 8
        assert actual.samples.inverse_t[i] == 0
        assert actual.samples.ndc[i].tolist() == pytest.approx([0.3, -0.4, 1.0], abs=1e-6)
    assert torch.isfinite(actual.rgb).all() and actual.composite.weights[-1] > 0
    assert render(field, bundle(origins, [direction, direction], far=1e6)).samples.num_intersected.tolist() == [8, 0]


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize("threshold", [0.0, 1e-3])
def test_a_ray_does_not_depend_on_its_batch(blends, threshold):
    field = random_field(4, True, seed=14, planes=30)
    origins, directions = random_rays(field.plan, 60, seed=15)
    order = np.random.default_rng(0).permutation(60)
    whole = render(field, bundle(origins, directions), threshold, blends)
    shuffled = render(field, bundle(origins[order], directions[order]), threshold, blends)
    assert torch.equal(whole.samples.num_intersected[order], shuffled.samples.num_intersected)
    assert torch.allclose(whole.rgb[order], shuffled.rgb, atol=1e-6)
    for size in (1, 7, 59):
        parts = [render(field, bundle(origins[i : i + size], directions[i : i + size]), threshold, blends)
                 for i in range(0, 60, size)]  # fmt: skip
        assert torch.allclose(whole.rgb, torch.cat([p.rgb for p in parts]), atol=1e-6)
        dropped = torch.cat([p.samples.dropped_mass for p in parts])
        assert torch.allclose(whole.samples.dropped_mass, dropped, atol=1e-6)


def ray_is_covered(plan, origin, direction, alone=True):
    """Alone: all heads of the plan, asked as one of several groups of heads that train apart."""
    mask = torch.ones(1, plan.num_heads, dtype=torch.bool) if alone else None
    rays = bundle([origin], [unit(direction)])
    return bool(render(MMPIField(plan).eval(), rays, head_mask=mask).samples.fully_covered)


def test_a_ray_is_explained_when_it_enters_before_the_first_content_and_stays_to_infinity():
    one = ScenePlan((make_mpi(near=1.0, extent=(-1.0, 1.0, -0.5, 0.5)),), None, 0.05, content_near=1.5)
    assert ray_is_covered(one, [0, 0, 0], [0, 0, 1])
    assert ray_is_covered(one, [0.4, 0.1, 3.0], [0.5, -0.2, 1]), "starts inside"
    assert not ray_is_covered(one, [0, 0, 0], [0, 0, -1]), "meets nothing"
    assert not ray_is_covered(one, [0, 0, 1.5], [1.3, 0, 1]), "leaves the frustum before infinity"
    assert not ray_is_covered(one, [-10, 0, 0], [0.9, 0, 1]), "enters far behind the first content"
    assert not ray_is_covered(one, [0, 0, -3], [0, 0, 1]), "reaches the first plane far behind the first content"
    with dispatch.chosen("torch"):
        assert ray_is_covered(replace(one, content_near=0.0), [0.4, 0.1, 3.0], [0.5, -0.2, 1]), "content at the camera"


def test_without_other_heads_all_that_a_ray_shows_is_to_be_explained():
    one = ScenePlan((make_mpi(near=1.0, extent=(-1.0, 1.0, -0.5, 0.5)),), None, 0.05, content_near=1.5)
    partly = [0, 0, 1.5], [1.3, 0, 1]
    assert ray_is_covered(one, *partly, alone=False) and not ray_is_covered(one, *partly)
    assert not ray_is_covered(one, [0, 0, 0], [0, 0, -1], alone=False), "meets nothing"
    cube = CubePlan((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0), (4, 4, 4))
    assert ray_is_covered(ScenePlan((make_mpi(),), cube, 0.05, 1.5), [0, 0, 0], [0, 0, -1], alone=False), "the cube"


def test_stopping_where_a_ray_is_opaque_changes_nothing_visible(monkeypatch):
    monkeypatch.setattr(dispatch, "_chosen", "torch")
    field = random_field(6, True, seed=16, planes=60, log_depths=(-3, 1.2))
    rays = bundle(*random_rays(field.plan, 80, seed=17))
    looked_up, march = [], importlib.import_module("mmpi_ns.sampler")
    shares = march.log_shares
    monkeypatch.setattr(march, "log_shares", lambda *args: looked_up.append(len(args[-1])) or shares(*args))
    stopped = render(field, rays, 1e-3, True)
    count = sum(looked_up)
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)
    whole = render(field, rays, 1e-3, True)
    assert count < 0.8 * (sum(looked_up) - count), "nothing was stopped"
    assert (stopped.rgb - whole.rgb).abs().max() < 1e-4
    assert (stopped.composite.accumulation - whole.composite.accumulation).abs().max() < 1e-4
