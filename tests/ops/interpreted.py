"""The Triton kernels by Triton's interpreter, on a CPU: run by test_gpu.py in a process with TRITON_INTERPRET=1."""

from __future__ import annotations

import math

import pytest
import torch
from bricked import bricked_field
from compiled import both, interpreted, normal  # noqa: F401
from fused import compare as compare_rendered
from fused import no_rays_give_empty_outputs
from kernel_cases import CASES, CLOSE, Shapes, differences
from marches import (
    HARD_RAYS,
    behind_an_opaque_plane_nothing_is_visited_and_a_hundred_thousandth_is_lost,
    compare,
    hard_plan,
    hard_rays,
    nothing_is_marched_without_rays_or_samples,
)
from random_fields import bundle, random_field, random_rays, sampled
from random_scenes import dense_grad

from mmpi_ns import blending
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import composite, interpolate
from mmpi_ns.ops.adam import AdamConstants, adam_rows
from mmpi_ns.ops.interpolate import Table
from mmpi_ns.ops.march import gpu
from mmpi_ns.scene.texels import BRICK


@pytest.mark.parametrize("shapes", [Shapes(), Shapes((1, 9), cube=False, channels=9)], ids=["2 MPIs", "1 and 9 MPIs"])
@pytest.mark.parametrize("name", sorted(CASES.keys() - {"adam_rows", "march", "render_fused"}))
def test_kernels_and_their_gradients_are_those_of_the_definitions(name, shapes):
    actual = differences(name, "cpu", shapes)
    assert actual and max(actual) < CLOSE


# Rows ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("channels", "taps"), [(1, 4), (9, 8)])
def test_interpolation_and_its_gradient_are_those_of_float64(channels, taps):
    g = torch.Generator().manual_seed(taps)
    rows, weights = torch.randint(0, 40, (300, taps), generator=g), torch.rand(300, taps, generator=g)
    table, exact = Table(normal(50, channels)), normal(50, channels).double().requires_grad_()
    upstream = normal(300, channels, seed=2)
    read = interpolate.interpolate(table, rows, weights)
    wanted = interpolate.interpolate_densely(exact, rows, weights.double())
    assert (read.double() - wanted).abs().max() < 2e-6
    (read * upstream).sum().backward()
    (wanted * upstream.double()).sum().backward()
    assert (dense_grad(table).double() - exact.grad).abs().max() < 2e-5
    assert exact.grad[40:].abs().max() == 0 < exact.grad.abs().max()


@pytest.mark.parametrize("spread", ["side by side", "anywhere", "one"])
@pytest.mark.parametrize("count", [1, 1500])
def test_distinct_rows_are_those_of_the_reference(count, spread):
    g, different, most = torch.Generator().manual_seed(count), 1 + count // 3, 2**17  # several programs of words
    chosen = torch.randint(0, different, (count, 4), generator=g)
    anywhere = torch.randint(0, most, (different,), generator=g)
    anywhere[0] = most - 1
    rows = {"side by side": chosen, "anywhere": anywhere[chosen], "one": chosen * 0}[spread]
    actual = interpolate.index_rows(rows, most)
    assert torch.equal(actual.unique, rows.unique())
    assert actual.positions.shape == rows.shape and torch.equal(actual.unique[actual.positions.long()], rows)


def test_padded_rows_end_in_row_0_which_nothing_is_added_to():
    rows = torch.tensor([[7, 3], [3, 90], [7, 7]])
    actual = interpolate.index_rows(rows, 100, pads=True)
    assert actual.unique.tolist() == [3, 7, 90, 0, 0, 0] and torch.equal(actual.unique[actual.positions.long()], rows)
    table = Table(normal(100, 1))
    interpolate.interpolate(table, rows, torch.ones(3, 2)).sum().backward()
    assert torch.equal(dense_grad(table)[:, 0], torch.bincount(rows.reshape(-1), minlength=100).float())


@pytest.mark.parametrize("pads", [False, True])
def test_no_rows_are_no_distinct_rows(pads):
    actual = interpolate.index_rows(torch.zeros(0, 4, dtype=torch.int64), 9, pads)
    assert actual.unique.shape == (0,) and actual.positions.shape == (0, 4)
    assert interpolate.sum_rows(actual.positions, torch.zeros(0, 3), torch.zeros(0, 4), 0).shape == (0, 3)


@pytest.mark.parametrize("channels", [9])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
def test_adam_on_rows_is_that_of_float64_and_leaves_the_rest_alone(channels, dtype):
    rows = torch.cat([torch.arange(3), torch.arange(BRICK, 5 * BRICK, 3), torch.zeros(5, dtype=torch.int64)])
    grad = normal(len(rows), channels, seed=1)
    grad[::4] = 0
    param, moments = normal(5 * BRICK, channels), normal(5 * BRICK, 2, channels, seed=2).abs().to(dtype)
    constants = AdamConstants(0.9, 0.99, 0.3, 1e-8, 0.05)
    wanted = param.double(), moments.double()
    adam_rows.reference(*wanted, rows, grad.double(), constants)
    before = param.clone()
    adam_rows(param, moments, rows, grad, constants)
    assert torch.allclose(param.double(), wanted[0], atol=1e-6)
    assert torch.allclose(moments.double(), wanted[1], rtol=1e-2 if dtype == torch.bfloat16 else 1e-6)
    assert torch.equal(param[:BRICK], before[:BRICK]) and not torch.equal(param, before)


def test_adam_on_all_of_a_tensor_is_that_of_float64():
    param, moments, grad = normal(2, 700), normal(2, 2, 700, seed=2).abs(), normal(2, 700, seed=1).clamp(min=0)
    constants = AdamConstants(0.9, 0.99, 0.3, 1e-8, 0.05)
    wanted, before = (param.double(), moments.double()), param.clone()
    adam_rows.reference(*wanted, None, grad.double(), constants)
    adam_rows(param, moments, None, grad, constants)
    assert torch.allclose(param.double(), wanted[0], atol=1e-6) and torch.allclose(moments.double(), wanted[1])
    assert torch.equal(param == before, grad == 0)


# March ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize("threshold", [0.0, 1e-2])
def test_the_march_keeps_what_the_reference_keeps(monkeypatch, blends, threshold):
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)  # the reference stops blending at T = 1e-4
    field = random_field(3, True, seed=3, planes=14)
    _, plain = compare(field, bundle(*random_rays(field.plan, 40, seed=1)), threshold, blends)
    assert plain.samples.heads.unique().numel() == 4
    assert (plain.samples.dropped_mass > 1e-3).any() == (threshold > 0)


def test_rays_pass_what_holds_nothing_like_the_reference():
    field = bricked_field(0.4)
    compare(field, bundle(*random_rays(field.plan, 40, seed=1)), 1e-3, True)


@pytest.mark.parametrize("raw", [0.0, 1e4])
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
        actual = {n: x for n, x in vars(fast.samples).items() if isinstance(x, torch.Tensor)}
        tensors = [fast.rgb, fast.composite.weights, *actual.values()]
        assert all(torch.isfinite(t.float()).all() for t in tensors)
    names = list(HARD_RAYS)
    heads = actual["heads"][actual["rays"] == names.index("on the axis")]
    assert raw != 0 or (heads == 1).any(), "equal distances: the twin's samples follow the first MPI's"
    assert (
        fast.samples.num_intersected[names.index("along the planes")] == 0
        and fast.samples.num_intersected[names.index("backwards")] > 0
    )


def test_behind_an_opaque_plane_the_march_visits_nothing():
    behind_an_opaque_plane_nothing_is_visited_and_a_hundred_thousandth_is_lost()


def test_without_rays_or_samples_there_is_nothing_to_march():
    nothing_is_marched_without_rays_or_samples()


def test_densities_that_are_no_numbers_end_the_march_all_the_same():
    field = random_field(2, False, seed=1, planes=10)
    field.density.data.fill_(math.nan)
    _, samples = sampled(field, bundle(*random_rays(field.plan, 5, seed=1)), 1e-3)
    assert len(samples.starts) == 6


def test_gradients_of_a_rendered_batch_are_those_of_plain_torch():
    field = random_field(3, True, seed=7, planes=12).train()
    rays, upstream = bundle(*random_rays(field.plan, 24, seed=8)), normal(24, 3, seed=9)
    params = {n: p for n, p in field.named_parameters() if p.numel()}

    def gradients():
        field.zero_grad(set_to_none=True)
        _, samples = sampled(field, rays, 1e-3, blends=True)
        tau, lookup = field.optical_depths(rays, samples)
        tau = blending.blended_optical_depth(tau, *field.sample_shares(rays, samples))
        made = composite.composite_weights(tau, samples.starts, samples.skipped_before, samples.skipped_total)
        colors = composite.render_colors(made, field.sample_colors(rays, samples, lookup), samples.starts)
        loss = (colors * upstream).sum() + made.accumulation.sum()
        (loss + 0.1 * field.total_variation(lookup, 1.0, 1.0)).backward()
        return {n: dense_grad(p) if isinstance(p, Table) else p.grad for n, p in params.items()}

    fast, plain = both(gradients)
    for name in ("density", "features", "reliability", "networks.weights"):
        size = plain[name].abs().max()
        assert size > 1e-3 and (fast[name] - plain[name]).abs().max() < 2e-4 * size, name


@pytest.mark.parametrize("blends", [True, False])
def test_pictures_show_what_the_reference_says(monkeypatch, blends):
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)  # the reference stops blending at T = 1e-4
    field = random_field(3, True, seed=3, planes=14)
    wanted = compare_rendered(field, bundle(*random_rays(field.plan, 20, seed=1)), 1e-2, blends)
    assert len(wanted.winner.unique()) > 2 and wanted.gathered.abs().amax(0).min() > 0.05
    assert (wanted.dropped_mass > 1e-3).any()


def test_thin_scenes_with_gaps_show_what_the_reference_says(monkeypatch):
    monkeypatch.setattr(gpu, "block_size", lambda wanted, device: 16)  # two programs, of different lengths
    field = bricked_field(0.4)
    rays = bundle(*random_rays(field.plan, 19, seed=1))
    wanted = compare_rendered(field, rays, 1e-3)
    assert (wanted.transmittance > 0.1).any()
    compare_rendered(field, rays, 1e-3, True)


def test_rays_that_meet_nothing_and_no_rays_show_nothing():
    no_rays_give_empty_outputs()
