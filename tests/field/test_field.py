"""The field's tables: how they start, grow, are emptied and read back, and who gets gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hand_made import make_mpi
from random_fields import bundle, fill, random_plan, random_rays, render, sampled
from random_scenes import dense_grad, of_rays

from mmpi_ns.blending import log_shares
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.tables import in_half_precision
from mmpi_ns.scene.plan import CubePlan, ScenePlan

TABLES = ("density", "features", "reliability")


def one_mpi(**size):
    return ScenePlan((make_mpi(extent=(-1.0, 1.0, -1.0, 1.0), **size),), None, 0.05, 1.0)


def block(field, k, table="features"):
    grid = field.grids[k]
    return getattr(field, table).detach()[grid.rows].view(grid.depth, grid.height, grid.width, -1).numpy()


# Start ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("planes", [2, 16, 64, 256])
def test_every_plane_starts_with_an_equal_share_of_a_ray_that_crosses_all(planes):
    actual = render(MMPIField(one_mpi(planes=planes)).eval(), bundle([[0, 0, 0]], [[0.1, 0.2, 0.97]]))
    assert actual.samples.starts.tolist() == [0, planes]
    # The last plane is not quite opaque: all that reaches it is 1/L, of which it takes 99.9 %.
    assert torch.allclose(actual.composite.weights, torch.tensor(1 / planes), rtol=2e-3)
    assert actual.composite.transmittance.item() == pytest.approx(0.001 / planes, rel=0.05)


def test_mpis_that_train_jointly_start_with_a_share_of_the_depth_each():
    plan = ScenePlan((make_mpi("a"), make_mpi("b"), make_mpi("c")), None, 0.05, 1.0)
    rays = bundle([[0, 0, 0]], [[0, 0, 1]])
    joint = render(MMPIField(plan, shares_depth=True).eval(), rays).composite
    alone = render(MMPIField(one_mpi()).eval(), rays).composite
    assert torch.allclose(joint.weights.view(9, 3).sum(-1), alone.weights, atol=1e-6)
    assert torch.allclose(joint.transmittance, alone.transmittance, atol=1e-6)


@pytest.mark.parametrize("alpha", [1e-2, 1e-4])
@pytest.mark.parametrize("per_voxel", [0.5, 2.0])
def test_a_sample_of_the_cube_starts_with_the_alpha_asked_for_at_any_sampling_rate(alpha, per_voxel):
    cube = CubePlan((-1.0, -1.0, 2.0), (1.0, 1.0, 4.0), (9, 9, 9))
    plan = ScenePlan((make_mpi(axes=((-1.0, 0, 0), (0, 1.0, 0), (0, 0, -1.0))),), cube, 0.05, 1.0)
    field = MMPIField(plan, cube_alpha=alpha, samples_per_voxel=per_voxel).eval()
    actual = render(field, bundle([[0, 0, 0]], [[0, 0, 1]]))
    assert actual.samples.num_intersected.item() == 8 * per_voxel  # 2 units of length, 8 voxel sides
    assert actual.composite.transmittance.item() == pytest.approx((1 - alpha) ** (8 * per_voxel), rel=1e-5)


def test_colours_start_gray_and_equal_in_every_head(plan):
    field = MMPIField(plan).eval()
    rgb = render(field, bundle(np.zeros((3, 3)), [[0, 0, 1], [0.3, 0, 0.95], [0, 0.1, 0.99]])).rgb
    accumulation = render(field, bundle(np.zeros((1, 3)), [[0, 0, 1]])).composite.accumulation
    assert torch.allclose(rgb[0], 0.5 * accumulation[0].expand(3))


# Growth and release --------------------------------------------------------------------------------------------------


def test_growing_keeps_the_parameters_and_a_bilinear_field():
    plan = random_plan(2, True, seed=0)
    field = MMPIField(plan)
    field.build(plan, 1 / 4)
    before = [getattr(field, name) for name in TABLES]
    for grid in field.grids:
        z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in (grid.depth, grid.height, grid.width)), indexing="ij")
        across = z if grid is field.grids[-1] else np.round(z * 50)  # planes of an MPI are independent
        for scale, name in enumerate(TABLES, 1):
            values = scale * (across + 2 * x - 3 * y + (x * y if grid is not field.grids[-1] else 0))
            getattr(field, name).data[grid.rows] = torch.tensor(values.reshape(-1, 1), dtype=torch.float32)
    rays = bundle(*random_rays(plan, 40, seed=1))
    coarse, layout = render(field.eval(), rays), field.layout
    field.grow(1.0)
    assert [getattr(field, name) for name in TABLES] == before and all(a is b for a, b in zip(
        before, (field.density, field.features, field.reliability), strict=True))  # fmt: skip
    rows = sum(len(g.own_tiles.reshape(-1)) for g in field.grids) * 64 + 64
    assert field.density.shape == (rows, 1) and field.plan == plan and field.touched.shape == (rows,)
    assert float(field.texel_factor) == 1.0 and [g.width for g in field.grids] == [7, 7, 4]
    fine = render(field, rays)
    assert (coarse.samples.num_intersected > 3).any()
    in_mpis = [x < 2 for x in of_rays(coarse, coarse.samples.heads)]
    mpi_only = torch.stack([x.all() for x in in_mpis])  # the cube's samples lie closer when it grows
    (long, thick), (short, thin) = ((x.cube.step, x.cube_interval) for x in (layout, field.layout))
    assert thin == 1 and long > 1.2 * short and thick == pytest.approx(long / short), "and are thinner"
    assert mpi_only.sum() > 5
    assert torch.allclose(coarse.composite.transmittance[mpi_only], fine.composite.transmittance[mpi_only], atol=1e-5)
    assert torch.allclose(coarse.rgb[mpi_only], fine.rgb[mpi_only], atol=1e-5)


def test_growing_keeps_texels_that_both_resolutions_share():
    """3 x 4 texels are every other of 5 x 7, with equal corners."""
    field = MMPIField(one_mpi(planes=3, height=6, width=8))
    field.build(one_mpi(planes=3, height=5, width=7), 1.0)
    small = one_mpi(planes=3, height=3, width=4)
    field.build(small, 1.0)
    field.features.data.normal_(generator=torch.Generator().manual_seed(0))
    old = block(field, 0).copy()
    field.full_plan = one_mpi(planes=3, height=5, width=7)
    field.grow(1.0)
    new = block(field, 0)
    assert np.allclose(new[:, ::2, ::2], old, atol=1e-6)
    assert np.allclose(new[:, ::2, 1::2], (old[:, :, 1:] + old[:, :, :-1]) / 2, atol=1e-6)


def test_released_texels_are_empty_and_the_others_stay_as_they_are(plan):
    field = fill(MMPIField(plan), seed=3)
    untouched = torch.rand(len(field.density), generator=torch.Generator().manual_seed(0)) < 0.5
    field.touched[untouched] = 0
    before = field.density.detach().clone()
    field.release_untouched()
    assert torch.equal(field.density[~untouched], before[~untouched])
    field.touched.fill_(0)
    field.release_untouched()
    actual = render(field, bundle(*random_rays(plan, 20, seed=0)))
    assert actual.samples.num_intersected.max() > 8
    assert actual.composite.weights.max() < 1e-6 and actual.composite.transmittance.min() > 0.9999


def test_a_head_votes_inside_its_frustum_where_it_was_trained_and_a_sample_counts_its_own_head_always(plan):
    """Ray along z from the origin: 'front' holds it all, 'left' and the cube a part."""
    field = fill(MMPIField(plan), seed=4)
    rays = bundle([[0, 0, 0]], [[0, 0, 1]])
    t = torch.tensor([1.5, 3.0, 6.0, 100.0])  # before the cube, in all three heads, behind it twice
    field.reliability.data.fill_(0.0)  # equal votes: P = 1 / number of heads that cover the point

    def shares(head):
        samples = (rays.origins.expand(4, 3), rays.directions.expand(4, 3), 1 / t, torch.full((4,), head))
        return (1 / log_shares(field.layout, field.tables, *samples)[0].exp()).round().tolist()

    # 'left' stands at (2, 0, 3), looks along -x from 2 units on, and reaches |z - 3| <= depth.
    assert shares(0) == [2, 3, 1, 1]
    assert shares(2) == [3, 3, 2, 2], "a sample's own head covers it"
    field.touched[field.grids[1].rows] = 0
    assert shares(0) == [1, 2, 1, 1] and shares(1) == [2, 3, 2, 2]
    field.touched.fill_(0)
    assert shares(0) == [1, 1, 1, 1]
    field.touched[field.grids[2].nearest(torch.tensor([[0.0, 0.0, -1 / 3]]))] = 1
    assert shares(0) == [1, 2, 1, 1], "the texel nearest to (0, 0, 3) votes"


# Gradients and training -----------------------------------------------------------------------------------------------


def trained_once(field, rays):
    field.train()
    samples = sampled(field, rays)
    tau, lookup = field.optical_depths(*samples)
    rgb = field.sample_colors(*samples, lookup)
    (tau.sum() + (rgb * tau.detach()[..., None]).sum()).backward()
    return samples, lookup


def test_gradients_are_those_of_the_rows_of_the_batch(plan):
    field = fill(MMPIField(plan), seed=5)
    field.touched.fill_(0)
    _, lookup = trained_once(field, bundle(*random_rays(plan, 3, seed=2)))
    rows = lookup.rows[lookup.taps.positions]
    read, weighted = set(rows.reshape(-1).tolist()), set(rows[lookup.taps.weights > 0].tolist())
    assert 0 < len(read) < plan.texels
    for table in (field.density, field.features):
        assert set(table.grad_rows.tolist()) == read and table.grad.shape == (len(read), table.shape[1])
        assert int(table.grad.any(-1).sum()) > 0.8 * len(weighted)
    assert set(field.touched.nonzero()[:, 0].tolist()) == read
    assert field.reliability.grad is None and field.networks.weights.grad is not None


@pytest.mark.parametrize("case", ["blending", "evaluating"])
def test_texels_count_as_trained_only_before_blending_and_in_training(plan, case):
    field = fill(MMPIField(plan), seed=5).train(case != "evaluating")
    field.marks_texels = case != "blending"
    field.touched.fill_(0)
    field.optical_depths(*sampled(field, bundle(*random_rays(plan, 3, seed=2))))
    assert field.touched.sum() == 0


def test_reliability_learns_where_heads_overlap(plan):
    field = fill(MMPIField(plan), seed=6)
    rays = bundle(np.zeros((2, 3)), [[0, 0, 1], [0.7, 0.2, 0.7]])
    samples = sampled(field, rays)
    log_p, _ = field.sample_shares(*samples)
    log_p[samples[1].heads == 0].sum().backward()
    grad = dense_grad(field.reliability)
    for grid in field.grids:
        assert grad[grid.rows].abs().sum() > 0
    assert abs(float(grad.sum())) < 1e-4, "raising all heads alike changes no share"


@pytest.mark.parametrize("with_cube", [False, True])
def test_total_variation_is_the_sum_over_touched_texels_and_their_neighbours(with_cube):
    mpis = (make_mpi("a", height=3, width=4, planes=3), make_mpi("b", (0.1, 0.0, 0.0), height=2, width=3, planes=2))
    cube = CubePlan((-1.0, -1.0, 2.0), (1.0, 1.0, 5.0), (3, 2, 4)) if with_cube else None
    field = fill(MMPIField(ScenePlan(mpis, cube, 0.05, 1.0), feature_channels=4), seed=7, log_depths=(-2, 0.5))
    samples = sampled(field, bundle([[0, 0, 0]], [[-0.4, -0.15, 0.9]]))
    _, lookup = field.optical_depths(*samples)
    touched = set(lookup.rows.tolist())
    wanted, gradient, size = 0.0, np.zeros(len(field.density)), field.plan.texels
    for k, grid in enumerate(field.grids):
        shape = (grid.depth, grid.height, grid.width)
        side = max(shape[1:])
        scales = (shape[0], side, side) if k < 2 else shape
        places = {row: i for i, row in enumerate(grid.rows.tolist())}
        for row in touched & set(places):
            z, y, x = np.unravel_index(places[row], shape)
            for axis in range(3):
                for step in (-1, 1):
                    other = np.array([z, y, x])
                    other[axis] += step
                    if not 0 <= other[axis] < shape[axis]:
                        continue
                    neighbour = int(grid.rows[np.ravel_multi_index(tuple(other), shape)])
                    scale = scales[axis] / 128 / 6
                    for table, weight in ((field.density, 2.0), (field.features, 0.5)):
                        for a, b in zip(table[row].tolist(), table[neighbour].tolist(), strict=True):
                            gap = abs(a - b)
                            wanted += weight * scale * (gap**2 / 2 if gap <= 1 else gap - 0.5)
                    gap = float(field.density[row, 0] - field.density[neighbour, 0])
                    gradient[row] += 2.0 * scale * min(max(gap, -1), 1)
    actual = field.total_variation(lookup, 2.0, 0.5)
    assert 0 < len(touched) < size and actual.item() == pytest.approx(wanted, rel=1e-4)
    actual.backward()
    assert np.allclose(dense_grad(field.density)[:, 0].numpy(), gradient, atol=1e-6)


def test_differences_of_chroma_count_more_in_the_gradient_of_features_alone():
    field = fill(MMPIField(ScenePlan((make_mpi("a", height=3, width=4, planes=3),), None, 0.05, 1.0)), seed=8)
    samples, gradients = sampled(field, bundle([[0, 0, 0]], [[-0.4, -0.15, 0.9]])), []
    for times in (0.0, 7.0):
        field.zero_grad(set_to_none=True)
        _, lookup = field.optical_depths(*samples)
        lookup.density.retain_grad(), lookup.features.retain_grad()
        (3 * field.total_variation(lookup, 1.0, 1.0, times) + lookup.features.sum()).backward()
        gradients.append((lookup.density.grad, lookup.features.grad.double()))
    (density, plain), (same_density, weighted) = gradients
    assert torch.equal(density, same_density) and plain.shape[1] > 3
    for before, after in zip((plain - 1).tolist(), (weighted - 1).tolist(), strict=True):
        mean = sum(before[:3]) / 3
        expected = [x + 7 * (x - mean) for x in before[:3]] + before[3:]
        assert after == pytest.approx(expected, abs=1e-5)
    assert (weighted - plain)[:, :3].abs().max() > 0.01


def test_a_batch_without_samples_has_no_variation_and_no_density(plan):
    field = MMPIField(plan)
    tau, lookup = field.optical_depths(*sampled(field, bundle([[0, 0, 0]], [[0, 0, -1]])))
    assert tau.shape == (0,)
    assert field.total_variation(lookup, 1.0, 1.0).item() == 0
    assert field.sample_colors(*sampled(field, bundle([[0, 0, 0]], [[0, 0, -1]]))).abs().sum() == 0


# State ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ours", "theirs"), [(1, 3), (3, 1), (2, 2), (4, 2)])
@pytest.mark.parametrize("factor", [1.0, 0.25])
def test_a_state_dict_brings_its_own_plan_and_resolution(ours, theirs, factor):
    def field(num_mpis, with_cube, seed):
        return MMPIField(random_plan(num_mpis, with_cube, seed), hidden_width=6)

    written, read = field(theirs, ours == 4, seed=11), field(ours, ours == 3, seed=22)
    written.build(written.full_plan, factor)
    fill(written, seed=1)
    parameters = dict(read.named_parameters())
    read.load_state_dict(written.state_dict())
    assert read.full_plan == written.full_plan and read.plan == written.plan
    assert all(parameters[name] is p for name, p in read.named_parameters())
    for name, value in written.state_dict().items():
        assert torch.equal(read.state_dict()[name], value), name
    rays = bundle(*random_rays(written.plan, 12, seed=3))
    a, b = (render(f.eval(), rays, blends=theirs > 1) for f in (written, read))
    assert (
        torch.equal(a.rgb, b.rgb)
        and torch.equal(a.samples.num_intersected, b.samples.num_intersected)
        and a.samples.num_intersected.any()
    )


def test_a_state_dict_without_a_plan_is_refused(plan):
    state = MMPIField(plan).state_dict()
    del state["plan_bytes"]
    with pytest.raises(ValueError, match="no scene plan"):
        MMPIField(plan).load_state_dict(state)


def test_tables_in_half_precision_stay_finite_and_nothing_else_changes():
    state = {
        "_model.field.density": torch.tensor([[-20.0], [0.1], [1e9], [-1e9]]),
        "features": torch.tensor([[0.3, -0.7]]),
        "_model.field.tiles": torch.tensor([70_000], dtype=torch.int32),
        "_model.field.networks.weights": torch.tensor([0.1]),
    }
    half = in_half_precision(state)
    assert {name for name, x in half.items() if x.dtype == torch.float16} == {"_model.field.density", "features"}
    assert half["_model.field.density"].float().tolist() == [[-20.0], [pytest.approx(0.1, rel=1e-3)], [65504], [-65504]]
    assert all(half[name] is state[name] for name in ("_model.field.tiles", "_model.field.networks.weights"))
    assert state["features"].dtype == torch.float32
