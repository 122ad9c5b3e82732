"""The Triton kernels by Triton's interpreter, on a CPU: run by test_triton.py in a process with TRITON_INTERPRET=1."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from hand_made import make_mpi, random_mpi, unit
from random_fields import OracleRay, bundle, fill, random_field, random_rays, render
from test_bricks import SHAPES, bricked_field, thinned

from mmpi_ns import compositing, mmpi_sampler
from mmpi_ns.mmpi_field import MMPIField
from mmpi_ns.mmpi_sampler import MMPISampler
from mmpi_ns.mmpi_samples import metadata_of
from mmpi_ns.ops import composite, interpolate, native
from mmpi_ns.ops.variation import total_variation, total_variation_reference
from mmpi_ns.placement.plan import CubePlan, ScenePlan
from mmpi_ns.touched_adam import TouchedAdam

triton_march = pytest.importorskip("mmpi_ns.ops.triton_march")
triton_tables = pytest.importorskip("mmpi_ns.ops.triton_tables")


@pytest.fixture(autouse=True)
def interpreted(monkeypatch):
    """Every test runs on the kernels; one that silently took plain torch would test nothing."""
    monkeypatch.setattr(native, "_chosen", "auto")
    native.interpret(True)
    assert native.takes_triton(torch.zeros(1)) and native.library(torch.zeros(1)) is None
    yield
    native.interpret(False)


def by_torch(work):
    """What ``work`` returns by plain torch."""
    native.choose("torch")
    try:
        return work()
    finally:
        native.choose("auto")


def normal(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


# Hits ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [math.inf, 6.0])
def test_rays_cross_the_planes_that_the_oracle_has(far):
    rng, checked = np.random.default_rng(1), 0
    plan = ScenePlan((*(random_mpi(rng, f"{k}", deep=d) for k, d in enumerate((math.inf, 1.01, 8.0))),), None, 0.3, 1.0)
    field = MMPIField(plan)
    origins, directions = random_rays(plan, 60, seed=2)
    rays = bundle(origins, directions, near=0.3, far=far)
    hits = field.plane_hits(rays.origins, rays.directions, rays.nears, rays.fars)
    assert hits.count.dtype == hits.m_first.dtype == torch.int64 and (hits.count == 0).any()
    for i in range(60):
        for k, mpi in enumerate(plan.mpis):
            found = oracle.crossings(mpi, origins[i], directions[i], 0.3, far)
            if min(c.margin for c in found) < 1e-5:
                continue
            live, checked = [c.plane for c in found if c.live], checked + 1
            assert hits.count[i, k] == len(live)
            assert not live or mpi.planes - 1 - int(hits.m_first[i, k]) == min(live)
    assert checked > 100


def test_hits_of_hard_rays_are_those_of_the_reference():
    plan = hard_plan()
    field, (origins, directions) = MMPIField(plan), (np.array(x, float) for x in zip(*HARD_RAYS.values(), strict=True))
    rays = bundle(origins, np.stack([unit(d) for d in directions]))
    found = field.plane_hits(rays.origins, rays.directions, rays.nears, rays.fars)
    wanted = by_torch(lambda: field.plane_hits(rays.origins, rays.directions, rays.nears, rays.fars))
    assert torch.equal(found.count, wanted.count) and (wanted.count > 0).any()
    live = wanted.count > 0
    assert torch.equal(found.m_first[live], wanted.m_first[live])
    for name in ("u", "v", "local_origins", "local_directions"):
        assert torch.allclose(getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=1e-5), name


# March ---------------------------------------------------------------------------------------------------------------


def compare(field, rays, threshold, form=None, **chosen):
    """The kernel's samples are the reference's; returns the kernel's rendering and the reference's."""
    fast = render(field, rays, threshold, form, **chosen)
    plain = by_torch(lambda: render(field, rays, threshold, form, **chosen))
    kept, wanted = fast.samples.metadata, plain.samples.metadata
    assert kept["valid"].shape == wanted["valid"].shape
    # A sample whose weight is the threshold's to the last bits may fall on either side of it.
    same = (kept["valid"].sum(1) == wanted["valid"].sum(1))[:, 0]
    assert same.float().mean() >= 0.95
    valid = wanted["valid"][same][..., 0]
    for name, error in (("heads", 0), ("planes", 0), ("ndc", 2e-6), ("inverse_t", 3e-5), ("tau", 2e-5)):
        a, b = (m[name][same][valid].double() for m in (kept, wanted))
        assert ((a - b).abs() <= error * (1 + b.abs())).all(), name
        assert kept[name].dtype == wanted[name].dtype
        assert (kept[name][~kept["valid"][..., 0]] == 0).all(), "empty slots are 0"
    before = [m["skipped_before"][same][valid] for m in (kept, wanted)]
    assert torch.allclose(*before, atol=2e-5)
    assert torch.equal(fast.report.live, plain.report.live)
    difference = (fast.report.dropped_mass - plain.report.dropped_mass)[same]
    if difference.numel():
        assert difference.min() > -2e-6 and difference.max() < 1.2e-5, "what is not visited counts as dropped"
        assert (fast.composite.transmittance - plain.composite.transmittance).abs()[same].max() < 1.2e-5
        assert (fast.rgb - plain.rgb).abs()[same].max() < 3e-5
    return fast, plain


@pytest.mark.parametrize("form", ["paper", "opacity", None])
@pytest.mark.parametrize("threshold", [0.0, 1e-2])
def test_the_march_keeps_what_the_reference_keeps(monkeypatch, form, threshold):
    monkeypatch.setattr(mmpi_sampler, "OPAQUE_DEPTH", math.inf)  # the reference stops blending at 1e-4 of the light
    field = random_field(3, True, seed=3, planes=14)
    _, plain = compare(field, bundle(*random_rays(field.plan, 40, seed=1)), threshold, form)
    valid = plain.samples.metadata["valid"]
    assert plain.samples.metadata["heads"][valid].unique().numel() == 4
    assert (plain.report.dropped_mass > 1e-3).any() == (threshold > 0)


def test_rays_pass_what_holds_nothing_like_the_reference():
    field = bricked_field(0.4)
    compare(field, bundle(*random_rays(field.plan, 40, seed=1)), 1e-3, "paper")


def test_nine_heads_and_several_programs_march_like_the_reference(monkeypatch):
    monkeypatch.setattr(triton_march, "block_size", lambda wanted, device: 16)
    field = random_field(9, False, seed=9, planes=10)
    compare(field, bundle(*random_rays(field.plan, 37, seed=1)), 1e-3)


def test_a_fair_share_keeps_what_a_threshold_alone_would_drop():
    field = MMPIField(ScenePlan((make_mpi(planes=40),), None, 0.05, 1.0)).eval()  # all weights are 1/40
    rays = bundle([[0, 0, 0]], [[0, 0, 1]])
    assert compare(field, rays, 0.1)[0].samples.metadata["valid"].sum() == 0
    assert compare(field, rays, 0.1, fair_share=0.1)[0].samples.metadata["valid"].sum() == 40


def test_rays_render_as_the_oracle_has_them():
    field = random_field(3, True, seed=5, planes=10)
    origins, directions = random_rays(field.plan, 30, seed=6)
    for form in ("paper", None):
        fast, checked = render(field, bundle(origins, directions), blend_form=form), 0
        for i in range(30):
            exact = OracleRay(field, origins[i], directions[i])
            if exact.margin < 1e-5:
                continue
            wanted, checked = exact.render(form), checked + 1
            assert int(fast.samples.metadata["valid"][i].sum()) == len(wanted.samples)
            assert np.abs(fast.rgb[i].double().numpy() - wanted.color).max() < 5e-5
            weights = fast.composite.weights[i, : len(wanted.samples)].double().numpy()
            assert np.abs(weights - wanted.weights).max() < 5e-5
            assert fast.composite.transmittance[i].item() == pytest.approx(wanted.transmittance, abs=5e-5)
        assert checked > 15


def hard_plan(**changes):
    twin = make_mpi("twin", planes=12)
    cube = CubePlan((-1.0, -1.0, 2.0), (1.0, 1.0, 4.0), (4, 4, 4))
    return ScenePlan((make_mpi(planes=12), twin, make_mpi("ends", near=0.5, far=3.0, planes=5)), cube, 0.05, 1.0)


HARD_RAYS = {
    "along the planes": ([0, 0, 1.5], [1, 0, 0]),
    "nearly along the planes": ([0, 0, 2], [1, 0, 2e-6]),
    "from a plane": ([0.1, 0.1, 1.0], [0, 0, 1]),
    "from behind all finite planes": ([0, 0, 500.0], [0.1, 0, 1]),
    "backwards": ([0, 0, 5], [0, 0, -1]),
    "on the border of the frustum": ([0, 0, 0], [1, 0.5, 1]),
    "on the axis": ([0, 0, 0], [0, 0, 1]),
    "into a corner of the cube": ([0, 0, 0], [0.5, 0.5, 2.0]),
    "from inside the cube": ([0.2, 0.1, 3.0], [0.3, 0.2, 1.0]),
    "from far away": ([0, 0, -1e5], [0, 0, 1]),
}


@pytest.mark.parametrize("raw", [0.0, 1e4, -1e4])
def test_hard_rays_through_thin_and_opaque_planes_march_like_the_reference(monkeypatch, raw):
    """Two MPIs coincide, so that every distance is a tie; raw densities make alpha 1 or 0."""
    monkeypatch.setattr(mmpi_sampler, "OPAQUE_DEPTH", math.inf)
    field = MMPIField(hard_plan(), feature_channels=5, hidden_width=6)
    field.reliability.data.normal_(generator=torch.Generator().manual_seed(1))
    field.density.data.fill_(raw)
    field.touched.fill_(1)
    origins, directions = (np.array(x, float) for x in zip(*HARD_RAYS.values(), strict=True))
    rays = bundle(origins, np.stack([unit(d) for d in directions]))
    for form, threshold in ((None, 0.0), (None, 1e-3), ("paper", 1e-3)):
        fast, _ = compare(field.eval(), rays, threshold, form)
        found = fast.samples.metadata
        tensors = [fast.rgb, fast.composite.weights, fast.report.dropped_mass, *found.values()]
        assert all(torch.isfinite(t.float()).all() for t in tensors)
    names = list(HARD_RAYS)
    heads = found["heads"][names.index("on the axis")][found["valid"][names.index("on the axis")]]
    assert raw != 0 or (heads == 1).any(), "equal distances: the twin's samples follow the first MPI's"
    assert fast.report.live[names.index("along the planes")] == 0 and fast.report.live[names.index("backwards")] > 0


def test_behind_an_opaque_plane_the_march_visits_nothing_and_loses_a_hundred_thousandth():
    field = MMPIField(ScenePlan((make_mpi(planes=64),), None, 0.05, 1.0)).eval()
    field.density.data[field.grids[0].rows[: 10 * field.grids[0].height * field.grids[0].width]] = 30.0
    found = render(field, bundle([[0, 0, 0]], [[0, 0, 1]]), threshold=1e-3)
    assert found.report.live.item() == 64 and found.samples.metadata["valid"].sum() == 1
    assert found.report.skipped_total.item() == 0 and found.report.dropped_mass.item() <= 1e-5


def test_without_rays_or_samples_there_is_nothing_to_march():
    field = MMPIField(ScenePlan((make_mpi(),), None, 0.05, 1.0)).eval()
    away = render(field, bundle([[0, 0, 0]], [[0, 0, -1]]), blend_form="paper")
    assert away.samples.metadata["valid"].sum() == 0 and away.composite.accumulation.item() == 0
    samples, report = MMPISampler()(bundle(torch.zeros(0, 3), torch.zeros(0, 3)), field=field, threshold=1e-3)
    assert samples.shape[0] == 0 and report.live.shape == (0,)


def test_densities_that_are_no_numbers_end_the_march_all_the_same():
    field = random_field(2, False, seed=1, planes=10)
    field.density.data.fill_(math.nan)
    samples, _ = MMPISampler()(bundle(*random_rays(field.plan, 5, seed=1)), field=field, threshold=1e-3)
    assert samples.shape[0] == 5


def test_gradients_of_a_rendered_batch_are_those_of_plain_torch():
    field = random_field(3, True, seed=7, planes=12).train()
    rays, upstream = bundle(*random_rays(field.plan, 24, seed=8)), normal(24, 3, seed=9)
    params = {n: p for n, p in field.named_parameters() if p.numel()}

    def gradients():
        field.zero_grad(set_to_none=True)
        samples, report = MMPISampler()(rays, field=field, threshold=1e-3, blend_form="paper")
        tau, lookup = field.get_density(samples)
        share = field.sample_shares(samples, lookup)
        flat = compositing.blended_optical_depth(tau.reshape(-1)[lookup.index], *share, "paper")
        tau = tau.new_zeros(tau[..., 0].numel()).index_put((lookup.index,), flat).view(tau.shape[:2])
        meta = metadata_of(samples)
        made = composite.composite_weights(
            tau, meta["valid"][..., 0], meta["skipped_before"][..., 0], report.skipped_total
        )  # fmt: skip
        colors = next(iter(field.get_outputs(samples, lookup).values()))
        loss = (compositing.render_colors(made, colors) * upstream).sum() + made.accumulation.sum()
        (loss + 0.1 * field.total_variation(lookup, 1.0, 1.0)).backward()
        return {n: p.grad.to_dense() if p.grad.is_sparse else p.grad for n, p in params.items()}

    fast, plain = gradients(), by_torch(gradients)
    for name in ("density", "features", "reliability", "networks.weights"):
        size = plain[name].abs().max()
        assert size > 1e-3 and (fast[name] - plain[name]).abs().max() < 2e-4 * size, name


# Rows ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("channels", "taps"), [(1, 4), (9, 4), (9, 8)])
def test_interpolation_and_its_gradient_are_those_of_float64(channels, taps):
    g = torch.Generator().manual_seed(taps)
    rows, weights = torch.randint(0, 40, (300, taps), generator=g), torch.rand(300, taps, generator=g)
    table, exact = normal(50, channels).requires_grad_(), normal(50, channels).double().requires_grad_()
    upstream = normal(300, channels, seed=2)
    read = interpolate.interpolate(table, rows, weights)
    wanted = interpolate.interpolate_reference(exact, rows, weights.double())
    assert (read.double() - wanted).abs().max() < 2e-6
    (read * upstream).sum().backward()
    (wanted * upstream.double()).sum().backward()
    assert table.grad.is_sparse and (table.grad.to_dense().double() - exact.grad).abs().max() < 2e-5
    assert exact.grad[40:].abs().max() == 0 < exact.grad.abs().max()


def test_gathered_rows_are_read_like_the_table_and_have_one_gradient_each():
    rows, weights = torch.randint(0, 50, (80, 4), generator=torch.Generator().manual_seed(1)), torch.rand(80, 4)
    index, some = interpolate.index_rows(rows), torch.arange(0, 80, 3)
    table, plain = (normal(50, 9).requires_grad_() for _ in range(2))
    gathered = interpolate.gather_rows(table, index.unique)
    read = interpolate.interpolate_gathered(gathered, index.position, weights)
    part = interpolate.interpolate_gathered(gathered, index.position[some], weights[some])
    wanted = interpolate.interpolate_reference(plain, rows, weights)
    assert torch.allclose(read, wanted, atol=1e-6) and torch.allclose(part, wanted[some], atol=1e-6)
    ((read**2).sum() + 2 * part.sum()).backward()
    ((wanted**2).sum() + 2 * wanted[some].sum()).backward()
    assert torch.allclose(table.grad.to_dense(), plain.grad, atol=1e-4)


@pytest.mark.parametrize("spread", ["side by side", "4096 apart", "anywhere", "one"])
@pytest.mark.parametrize("count", [1, 7, 3000])
def test_distinct_rows_are_those_of_the_reference(count, spread):
    g, different = torch.Generator().manual_seed(count), 1 + count // 3
    chosen = torch.randint(0, different, (count, 4), generator=g)
    anywhere = torch.randint(0, 2**40, (different,), generator=g)
    rows = {"side by side": chosen, "4096 apart": chosen * 4096, "anywhere": anywhere[chosen], "one": chosen * 0}[
        spread
    ]
    found = interpolate.index_rows(rows)
    assert torch.equal(found.unique.sort()[0], rows.unique())
    assert found.position.shape == rows.shape and torch.equal(found.unique[found.position.long()], rows)


def test_no_rows_are_no_distinct_rows():
    found = interpolate.index_rows(torch.zeros(0, 4, dtype=torch.int64))
    assert found.unique.shape == (0,) and found.position.shape == (0, 4)
    assert interpolate.add_rows(found, torch.zeros(0, 3), torch.zeros(0, 4)).shape == (0, 3)


@pytest.mark.parametrize("weighted", [True, False])
def test_rows_gather_what_their_entries_give(weighted):
    rows = torch.randint(0, 40, (300, 4 if weighted else 1), generator=torch.Generator().manual_seed(1))
    values, weights = normal(300, 9), torch.rand(300, 4) if weighted else None
    index = interpolate.index_rows(rows)
    found = torch.zeros(40, 9).index_copy_(0, index.unique, interpolate.add_rows(index, values, weights))
    each = values[:, None].double() * (torch.ones(300, 1) if weights is None else weights)[..., None].double()
    wanted = torch.zeros(40, 9, dtype=torch.float64).index_add_(0, rows.reshape(-1), each.reshape(-1, 9))
    assert wanted.abs().max() > 1 and (found.double() - wanted).abs().max() < 1e-5


def test_taps_are_those_of_the_grids_also_at_borders_and_outside():
    field = bricked_field()
    g = torch.Generator().manual_seed(1)
    ndc = torch.rand(200, 3, generator=g) * 2.4 - 1.2
    ndc[:20] = ndc[:20].sign()
    heads, planes = torch.randint(0, 3, (200,), generator=g), torch.randint(0, 9, (200,), generator=g)
    scene, table = field.triton_scene()[0], normal(len(field.density), 1)
    rows, weights = triton_tables.taps(scene, heads, planes, ndc, in_cube=False)
    for k in range(3):
        own = heads == k
        wanted_rows, wanted_weights = field.grids[k].bilinear(planes[own], ndc[own])
        assert torch.equal(rows[own], wanted_rows) and torch.allclose(weights[own], wanted_weights, atol=2e-6)
    rows, weights = triton_tables.taps(scene, torch.full_like(heads, 3), planes, ndc, in_cube=True)
    wanted = interpolate.interpolate_reference(table, *field.grids[3].trilinear(ndc))
    assert torch.allclose(interpolate.interpolate_reference(table, rows, weights), wanted, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 9])
def test_variation_equals_the_reference_with_its_gradient(channels):
    grids, _, _ = thinned(SHAPES)
    table = normal(len(grids[0].places) * 64, channels) * 2
    texels = torch.cat([g.rows[g.rows >= 64] for g in grids] + [torch.arange(5)])  # and some of the empty brick
    rows = texels[torch.randperm(len(texels), generator=torch.Generator().manual_seed(1))[:-9]]
    scales, found = [(0.5 + k, 2.0, 1.0) for k in range(len(grids))], []
    for function, dtype in ((total_variation, torch.float32), (total_variation_reference, torch.float64)):
        values = table[rows].to(dtype).requires_grad_()
        value = function(values, table.to(dtype), rows, grids, scales)
        (3 * value).backward()
        found.append((value.item(), values.grad.double()))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5) and found[0][0] > 1
    assert torch.allclose(found[0][1], found[1][1], atol=1e-5)


def test_adam_on_rows_equals_the_plain_one():
    def work():
        param = torch.nn.Parameter(normal(500, 9))
        optimizer = TouchedAdam([param], lr=0.1)
        for step in range(4):
            rows = torch.randint(0, 500, (300,), generator=torch.Generator().manual_seed(step))
            values = normal(300, 9, seed=step)
            values[:, step] = 0  # entries without a gradient within a touched row
            param.grad = torch.sparse_coo_tensor(rows[None], values, param.shape)
            optimizer.step()
        return param.data, optimizer.state[param]["exp_avg"], optimizer.state[param]["exp_avg_sq"]

    fast, plain = work(), by_torch(work)
    assert (plain[0] - normal(500, 9)).abs().max() > 0.2
    for a, b in zip(fast, plain, strict=True):
        assert ((a - b).abs() <= 3e-6 * (1 + b.abs())).all()


# Colours -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(("channels", "width", "octaves"), [(3, 5, (0, 0)), (9, 32, (2, 2)), (4, 64, (4, 1))])
def test_shading_equals_the_colour_networks(channels, width, octaves, shared):
    plan = random_field(3, True, seed=7).plan
    field = MMPIField(
        plan,
        feature_channels=channels,
        hidden_width=width,
        position_frequencies=octaves[0],
        direction_frequencies=octaves[1],
        shared_colour=shared,
    ).eval()
    field.features.data = normal(*field.features.shape, seed=1) * 2
    field.networks.weights.data = normal(*field.networks.weights.shape, seed=2) * 0.3
    samples, _ = MMPISampler()(bundle(*random_rays(plan, 30, seed=8)), field=field, threshold=0.0)
    assert samples.metadata["heads"].unique().numel() == 4
    with torch.no_grad():
        fast = next(iter(field.get_outputs(samples).values()))
        plain = by_torch(lambda: next(iter(field.get_outputs(samples).values())))
    assert plain.std() > 0.05 and (fast - plain).abs().max() < 5e-6
    assert (fast[~samples.metadata["valid"][..., 0]] == 0).all()


def test_without_samples_there_are_no_colours():
    field = random_field(2, seed=1)
    samples, _ = MMPISampler()(bundle([[0, 0, 0]], [[0, 0, 1]], far=1e-3), field=field, threshold=0.0)
    with torch.no_grad():
        assert (next(iter(field.get_outputs(samples).values())) == 0).all()


# Compositing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slots", [1, 5, 70])
def test_compositing_and_its_gradient_are_those_of_float64(slots):
    g = torch.Generator().manual_seed(slots)
    tau = 10 ** (torch.rand(40, slots, generator=g) * 6 - 5)
    tau[0], tau[1], tau[2, : slots // 2] = 0.0, 1e4, 1e5
    valid = torch.arange(slots) < torch.randint(0, slots + 1, (40, 1), generator=g)
    before = torch.rand(40, slots, generator=g).cumsum(1) * 0.02
    total = before[:, -1:] + 0.1
    upstream = [normal(40, slots, seed=1), normal(40, 1, seed=2), normal(40, 1, seed=3)]

    def work(function, dtype):
        leaf = tau.detach().to(dtype, copy=True).requires_grad_()
        made = function(leaf, valid, before.to(dtype), total.to(dtype))
        parts = (made.weights, made.accumulation, made.transmittance)
        sum((p * u.to(dtype)).sum() for p, u in zip(parts, upstream, strict=True)).backward()
        return [x.double() for x in (*parts, leaf.grad)]

    fast = work(composite.composite_weights, torch.float32)
    exact = work(compositing.composite_weights, torch.float64)
    for a, b in zip(fast, exact, strict=True):
        assert ((a - b).abs() <= 3e-6 * (1 + b.abs().amax(1, keepdim=True))).all()
    assert (fast[0][~valid] == 0).all() and (fast[3][~valid] == 0).all()


def test_thin_samples_keep_their_digits():
    tau = torch.full((1, 3), 1e-7)
    made = composite.composite_weights(tau, tau > 0, tau * 0, tau[:, :1] * 0)
    assert made.weights.tolist()[0] == pytest.approx([1e-7] * 3, rel=1e-6)


def test_no_rays_are_composited_to_nothing():
    tau = torch.zeros(0, 4, requires_grad=True)
    made = composite.composite_weights(tau, tau > 0, tau * 0, torch.zeros(0, 1))
    made.weights.sum().backward()
    assert made.weights.shape == (0, 4) and made.accumulation.shape == (0, 1)


# The whole -----------------------------------------------------------------------------------------------------------


def test_a_field_of_trained_and_untrained_texels_blends_like_the_reference(monkeypatch):
    monkeypatch.setattr(mmpi_sampler, "OPAQUE_DEPTH", math.inf)
    field = fill(MMPIField(random_field(3, True, seed=11).plan, feature_channels=5, hidden_width=6), 11)
    field.touched.copy_(torch.rand(len(field.touched), generator=torch.Generator().manual_seed(1)) < 0.5)
    compare(field, bundle(*random_rays(field.plan, 40, seed=2)), 1e-3, "paper")
