"""The Triton kernels by Triton's interpreter, on a CPU: run by test_gpu.py in a process with TRITON_INTERPRET=1."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from bricked import bricked_field
from hand_made import make_mpi, random_mpi
from hard_rays import HARD_RAYS, hard_plan, hard_rays
from interpreting import by_torch, interpreted, normal  # noqa: F401
from random_fields import OracleRay, bundle, fill, random_field, random_rays, render, sampled
from random_scenes import dense_grad

from mmpi_ns import blending
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import composite
from mmpi_ns.ops.interpolate import Table
from mmpi_ns.ops.march import MarchOptions, gpu
from mmpi_ns.sampler import march, rays_of
from mmpi_ns.scene.plan import CubePlan, ScenePlan

# Crossings -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [math.inf, 6.0])
def test_rays_cross_the_planes_that_the_oracle_has(far):
    rng, checked, missed = np.random.default_rng(1), 0, 0
    plan = ScenePlan((*(random_mpi(rng, f"{k}", deep=d) for k, d in enumerate((math.inf, 1.01, 8.0))),), None, 0.3, 1.0)
    field = MMPIField(plan)
    origins, directions = random_rays(plan, 60, seed=2)
    m = march(field.layout, field.tables, rays_of(bundle(origins, directions, near=0.3, far=far)), MarchOptions(0.0))
    assert torch.equal(m.live, m.valid.sum(1))
    for i in range(60):
        for k, mpi in enumerate(plan.mpis):
            expected = oracle.crossings(mpi, origins[i], directions[i], 0.3, far)
            if min(c.margin for c in expected) < 1e-5:
                continue
            live, checked = [c for c in expected if c.live], checked + 1
            missed += not live
            mine = m.valid[i] & (m.heads[i] == k)
            assert m.planes[i][mine].tolist() == [c.plane for c in live]
            (u0, u1, v0, v1), places = mpi.extent, m.ndc[i][mine].double().numpy()
            for c, (u, v, _), inverse_t in zip(live, places, m.inverse_t[i][mine].tolist(), strict=True):
                scaled = 2 * (c.u - u0) / (u1 - u0) - 1, 2 * (c.v - v0) / (v1 - v0) - 1
                assert (u, v) == pytest.approx(scaled, abs=2e-5) and inverse_t == pytest.approx(c.inverse_t, rel=1e-4)
    assert checked > 100 and missed > 10


@pytest.mark.parametrize("near", [0.3, 2.53])
def test_rays_meet_the_samples_of_the_cube_that_float64_has(near):
    """Sample i lies at distance (i + 1/2) step; of those within the cube all are met."""
    cube, rng = CubePlan((-1.0, -0.8, 1.5), (0.9, 1.1, 3.5), (6, 5, 4)), np.random.default_rng(3)
    field = MMPIField(ScenePlan((make_mpi(planes=2),), cube, 0.05, 1.0), samples_per_voxel=4.0)
    directions = rng.normal(size=(40, 3)) * [0.4, 0.4, 1] + [0, 0, 1]
    directions[:4] = [[0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 0.1, 1]]  # along an axis: no bound within a slab
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.normal(size=(40, 3)) * 0.3
    m = march(field.layout, field.tables, rays_of(bundle(origins, directions, near=near)), MarchOptions(0.0))
    step, checked = float(field.layout.cube.step), 0
    for i in range(40):
        t = (np.arange(400) + 0.5) * step
        points = origins[i] + t[:, None] * directions[i]
        depth = np.minimum(points - np.array(cube.lower), np.array(cube.upper) - points).min(1)
        if min(np.abs(depth).min(), np.abs(t - near).min()) < 1e-5:
            continue
        inside, checked = (depth > 0) & (t > near), checked + 1
        mine = m.valid[i] & (m.heads[i] == 1)
        assert m.planes[i][mine].tolist() == inside.nonzero()[0].tolist()
        assert m.inverse_t[i][mine].tolist() == pytest.approx(1 / t[inside], rel=1e-5)
    assert checked > 30 and (m.heads[m.valid] == 1).sum() > 100


@pytest.mark.parametrize("cube", [True, False])
def test_only_heads_that_may_answer_a_ray_do_and_it_is_explained_as_by_the_reference(cube):
    """Heads by name, the MPI of highest priority, and both; one MPI ends, one is entered late, one reaches infinity."""
    g = torch.Generator().manual_seed(1)
    plan = random_field(3, cube, seed=3, planes=14).plan
    plan = ScenePlan((*plan.mpis, make_mpi("ends", far=9.0, planes=7)), plan.cube, 0.05, 0.7)
    field = fill(MMPIField(plan, feature_channels=5, hidden_width=6), 3)
    rays, seen = bundle(*random_rays(plan, 60, seed=1)), set()
    mask = torch.rand(60, plan.num_heads, generator=g) < 0.5
    priorities = torch.rand(60, 4, generator=g)
    for chosen in ({"head_mask": mask}, {"choose": priorities}, {"head_mask": mask, "choose": priorities}):
        _, plain = compare(field, rays, 1e-3, **chosen)
        seen |= set(plain.samples.explained.flatten().tolist())
    assert seen == {True, False}


# March ---------------------------------------------------------------------------------------------------------------


def compare(field, rays, threshold, blends=False, **chosen):
    """The kernel's samples are the reference's; returns the kernel's rendering and the reference's."""
    fast = render(field, rays, threshold, blends, **chosen)
    plain = by_torch(lambda: render(field, rays, threshold, blends, **chosen))
    kept, wanted = vars(fast.samples), vars(plain.samples)
    assert kept["valid"].shape == wanted["valid"].shape
    # A sample whose weight is the threshold's to the last bits may fall on either side of it.
    same = kept["valid"].sum(1) == wanted["valid"].sum(1)
    assert same.float().mean() >= 0.95
    valid = wanted["valid"][same]
    for name, error in (("heads", 0), ("planes", 0), ("ndc", 2e-6), ("inverse_t", 3e-5), ("tau", 2e-5)):
        a, b = (m[name][same][valid].double() for m in (kept, wanted))
        assert ((a - b).abs() <= error * (1 + b.abs())).all(), name
        assert kept[name].dtype == wanted[name].dtype
        assert (kept[name][~kept["valid"][..., 0]] == 0).all(), "empty slots are 0"
    before = [m["skipped_before"][same][valid] for m in (kept, wanted)]
    assert torch.allclose(*before, atol=2e-5)
    assert torch.equal(fast.samples.live, plain.samples.live)
    assert torch.equal(fast.samples.explained, plain.samples.explained)
    difference = (fast.samples.dropped_mass - plain.samples.dropped_mass)[same]
    if difference.numel():
        assert difference.min() > -2e-6 and difference.max() < 1.2e-5, "what is not visited counts as dropped"
        assert (fast.composite.transmittance - plain.composite.transmittance).abs()[same].max() < 1.2e-5
        assert (fast.rgb - plain.rgb).abs()[same].max() < 3e-5
    return fast, plain


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize("threshold", [0.0, 1e-2])
def test_the_march_keeps_what_the_reference_keeps(monkeypatch, blends, threshold):
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)  # the reference stops blending at 1e-4 of the light
    field = random_field(3, True, seed=3, planes=14)
    _, plain = compare(field, bundle(*random_rays(field.plan, 40, seed=1)), threshold, blends)
    valid = plain.samples.valid
    assert plain.samples.heads[valid].unique().numel() == 4
    assert (plain.samples.dropped_mass > 1e-3).any() == (threshold > 0)


def test_rays_pass_what_holds_nothing_like_the_reference():
    field = bricked_field(0.4)
    compare(field, bundle(*random_rays(field.plan, 40, seed=1)), 1e-3, True)


def test_nine_heads_and_several_programs_march_like_the_reference(monkeypatch):
    monkeypatch.setattr(gpu, "block_size", lambda wanted, device: 16)
    field = random_field(9, False, seed=9, planes=10)
    compare(field, bundle(*random_rays(field.plan, 37, seed=1)), 1e-3)


def test_a_fair_share_keeps_what_a_threshold_alone_would_drop():
    field = MMPIField(ScenePlan((make_mpi(planes=40),), None, 0.05, 1.0)).eval()  # all weights are 1/40
    rays = bundle([[0, 0, 0]], [[0, 0, 1]])
    assert compare(field, rays, 0.1)[0].samples.valid.sum() == 0
    assert compare(field, rays, 0.1, fair_share=0.1)[0].samples.valid.sum() == 40


def test_rays_render_as_the_oracle_has_them():
    field = random_field(3, True, seed=5, planes=10)
    origins, directions = random_rays(field.plan, 30, seed=6)
    for blends in (True, False):
        fast, checked = render(field, bundle(origins, directions), blends=blends), 0
        for i in range(30):
            exact = OracleRay(field, origins[i], directions[i])
            if exact.margin < 1e-5:
                continue
            wanted, checked = exact.render(blends), checked + 1
            assert int(fast.samples.valid[i].sum()) == len(wanted.samples)
            assert np.abs(fast.rgb[i].double().numpy() - wanted.color).max() < 5e-5
            weights = fast.composite.weights[i, : len(wanted.samples)].double().numpy()
            assert np.abs(weights - wanted.weights).max() < 5e-5
            assert fast.composite.transmittance[i].item() == pytest.approx(wanted.transmittance, abs=5e-5)
        assert checked > 15


@pytest.mark.parametrize("raw", [0.0, 1e4, -1e4])
def test_hard_rays_through_thin_and_opaque_planes_march_like_the_reference(monkeypatch, raw):
    """Two MPIs coincide, so that every distance is a tie; raw densities make alpha 1 or 0."""
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)
    field = MMPIField(hard_plan(), feature_channels=5, hidden_width=6)
    field.reliability.data.normal_(generator=torch.Generator().manual_seed(1))
    field.density.data.fill_(raw)
    field.touched.fill_(1)
    rays = hard_rays()
    for blends, threshold in ((False, 0.0), (False, 1e-3), (True, 1e-3)):
        fast, _ = compare(field.eval(), rays, threshold, blends)
        found = {n: x for n, x in vars(fast.samples).items() if isinstance(x, torch.Tensor)}
        tensors = [fast.rgb, fast.composite.weights, *found.values()]
        assert all(torch.isfinite(t.float()).all() for t in tensors)
    names = list(HARD_RAYS)
    heads = found["heads"][names.index("on the axis")][found["valid"][names.index("on the axis")]]
    assert raw != 0 or (heads == 1).any(), "equal distances: the twin's samples follow the first MPI's"
    assert fast.samples.live[names.index("along the planes")] == 0 and fast.samples.live[names.index("backwards")] > 0


def test_behind_an_opaque_plane_the_march_visits_nothing_and_loses_a_hundred_thousandth():
    field = MMPIField(ScenePlan((make_mpi(planes=64),), None, 0.05, 1.0)).eval()
    field.density.data[field.grids[0].rows[: 10 * field.grids[0].height * field.grids[0].width]] = 30.0
    found = render(field, bundle([[0, 0, 0]], [[0, 0, 1]]), threshold=1e-3)
    assert found.samples.live.item() == 64 and found.samples.valid.sum() == 1
    assert found.samples.skipped_total.item() == 0 and found.samples.dropped_mass.item() <= 1e-5


def test_without_rays_or_samples_there_is_nothing_to_march():
    field = MMPIField(ScenePlan((make_mpi(),), None, 0.05, 1.0)).eval()
    away = render(field, bundle([[0, 0, 0]], [[0, 0, -1]]), blends=True)
    assert away.samples.valid.sum() == 0 and away.composite.accumulation.item() == 0
    _, samples = sampled(field, bundle(torch.zeros(0, 3), torch.zeros(0, 3)), 1e-3)
    assert samples.valid.shape[0] == 0 and samples.live.shape == (0,)


def test_densities_that_are_no_numbers_end_the_march_all_the_same():
    field = random_field(2, False, seed=1, planes=10)
    field.density.data.fill_(math.nan)
    _, samples = sampled(field, bundle(*random_rays(field.plan, 5, seed=1)), 1e-3)
    assert samples.valid.shape[0] == 5


def test_gradients_of_a_rendered_batch_are_those_of_plain_torch():
    field = random_field(3, True, seed=7, planes=12).train()
    rays, upstream = bundle(*random_rays(field.plan, 24, seed=8)), normal(24, 3, seed=9)
    params = {n: p for n, p in field.named_parameters() if p.numel()}

    def gradients():
        field.zero_grad(set_to_none=True)
        _, samples = sampled(field, rays, 1e-3, blends=True)
        tau, lookup = field.optical_depths(rays, samples)
        share = field.sample_shares(rays, samples, lookup)
        flat = blending.blended_optical_depth(tau.reshape(-1)[lookup.index], *share)
        tau = tau.new_zeros(tau.numel()).index_put((lookup.index,), flat).view(tau.shape)
        made = composite.composite_weights(tau, samples.valid, samples.skipped_before, samples.skipped_total)
        colors = field.sample_colors(rays, samples, lookup)
        loss = (composite.render_colors(made, colors) * upstream).sum() + made.accumulation.sum()
        (loss + 0.1 * field.total_variation(lookup, 1.0, 1.0)).backward()
        return {n: dense_grad(p) if isinstance(p, Table) else p.grad for n, p in params.items()}

    fast, plain = gradients(), by_torch(gradients)
    for name in ("density", "features", "reliability", "networks.weights"):
        size = plain[name].abs().max()
        assert size > 1e-3 and (fast[name] - plain[name]).abs().max() < 2e-4 * size, name


# The whole -----------------------------------------------------------------------------------------------------------


def test_a_field_of_trained_and_untrained_texels_blends_like_the_reference(monkeypatch):
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)
    field = fill(MMPIField(random_field(3, True, seed=11).plan, feature_channels=5, hidden_width=6), 11)
    field.touched.copy_(torch.rand(len(field.touched), generator=torch.Generator().manual_seed(1)) < 0.5)
    compare(field, bundle(*random_rays(field.plan, 40, seed=2)), 1e-3, True)
