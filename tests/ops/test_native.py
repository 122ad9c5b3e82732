"""The compiled kernels against their references in plain torch, and what happens where they cannot be had."""

from __future__ import annotations

import copy
import math
import subprocess

import pytest
import torch
from hand_made import make_mpi
from random_fields import bundle, random_field, random_rays, render

from mmpi_ns.field.color_network import ColorNetworks
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import native
from mmpi_ns.ops.colors import PART as COLOUR_PART
from mmpi_ns.ops.colors import colors
from mmpi_ns.ops.interpolate import add_rows, gather_rows, index_rows, interpolate_gathered, interpolate_reference
from mmpi_ns.ops.variation import PART, total_variation, total_variation_reference
from mmpi_ns.rendering import sampler as mmpi_sampler
from mmpi_ns.rendering.sampler import MMPISampler
from mmpi_ns.scene.plan import CubePlan, ScenePlan
from mmpi_ns.scene.texels import BRICK, make_grids
from mmpi_ns.training.touched_adam import TouchedAdam


@pytest.fixture(autouse=True)
def compiled(monkeypatch):
    """The machine that runs the tests has a compiler: a kernel that silently is not there would test nothing."""
    monkeypatch.setattr(native, "_chosen", "auto")
    assert native.library(torch.zeros(1)) is not None


def both(monkeypatch, work):
    """What ``work`` returns by the compiled kernels and by plain torch."""
    fast = work()
    monkeypatch.setattr(native, "_chosen", "torch")
    plain = work()
    monkeypatch.setattr(native, "_chosen", "auto")
    return fast, plain


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


# March ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["paper", "opacity", None])
@pytest.mark.parametrize(("num_mpis", "with_cube"), [(1, False), (4, True), (9, False)])
@pytest.mark.parametrize("threshold", [0.0, 1e-3, 3e-2])
def test_the_march_keeps_what_the_reference_keeps(monkeypatch, num_mpis, with_cube, form, threshold):
    monkeypatch.setattr(mmpi_sampler, "OPAQUE_DEPTH", math.inf)  # the reference stops blending at 1e-4 of the light
    field = random_field(num_mpis, with_cube, seed=num_mpis, planes=40)
    rays = bundle(*random_rays(field.plan, 200, seed=1))
    fast, plain = both(monkeypatch, lambda: render(field, rays, threshold, form))
    kept, wanted = fast.samples.metadata, plain.samples.metadata
    # A sample whose weight is the threshold's to the last bits may fall on either side of it.
    same = (kept["valid"].sum(1) == wanted["valid"].sum(1))[:, 0]
    assert same.float().mean() > 0.98 and wanted["valid"].any()
    width = min(kept["valid"].shape[1], wanted["valid"].shape[1])
    valid = wanted["valid"][same, :width, 0]
    for name, error in (("heads", 0), ("planes", 0), ("ndc", 1e-5), ("inverse_t", 1e-4), ("tau", 3e-5)):
        a, b = (m[name][same, :width][valid].double() for m in (kept, wanted))
        assert ((a - b).abs() <= error * (1 + b.abs())).all(), name
    assert torch.allclose(
        kept["skipped_before"][same, :width][valid], wanted["skipped_before"][same, :width][valid], atol=2e-5
    )
    for name in ("heads", "planes", "ndc", "inverse_t", "tau", "skipped_before"):
        assert (kept[name][~kept["valid"][..., 0]] == 0).all(), "empty slots are 0"
    assert torch.equal(fast.report.live, plain.report.live)
    assert (fast.composite.transmittance - plain.composite.transmittance).abs().max() < 1.2e-5
    difference = fast.report.dropped_mass - plain.report.dropped_mass
    assert difference[same].min() > -2e-6 and difference[same].max() < 1.2e-5, "what is not visited counts as dropped"
    assert (fast.rgb - plain.rgb).abs()[same].max() < 3e-5


def test_behind_an_opaque_plane_the_march_visits_nothing_and_loses_a_hundred_thousandth():
    field = MMPIField(ScenePlan((make_mpi(planes=64),), None, 0.05, 1.0)).eval()
    field.density.data[field.grids[0].rows[: 10 * field.grids[0].height * field.grids[0].width]] = 30.0
    found = render(field, bundle([[0, 0, 0]], [[0, 0, 1]]), threshold=1e-3)
    assert found.report.live.item() == 64 and found.samples.metadata["valid"].sum() == 1
    assert found.report.skipped_total.item() == 0 and found.report.dropped_mass.item() <= 1e-5
    assert found.composite.accumulation.item() == pytest.approx(1, abs=1e-5)


def test_without_rays_or_samples_there_is_nothing_to_march():
    field = MMPIField(ScenePlan((make_mpi(),), None, 0.05, 1.0)).eval()
    away = render(field, bundle([[0, 0, 0]], [[0, 0, -1]]), blend_form="paper")
    assert away.samples.metadata["valid"].sum() == 0 and away.composite.accumulation.item() == 0
    samples, report = MMPISampler()(bundle(torch.zeros(0, 3), torch.zeros(0, 3)), field=field, threshold=1e-3)
    assert samples.shape[0] == 0 and report.live.shape == (0,)


def test_results_do_not_depend_on_the_number_of_threads():
    field = random_field(4, True, seed=5, planes=40)
    rays, threads = bundle(*random_rays(field.plan, 1200, seed=6)), torch.get_num_threads()
    found = []
    for count in (1, 3):
        try:
            torch.set_num_threads(count)
            found.append(render(field, rays, 1e-3, "paper"))
        finally:
            torch.set_num_threads(threads)
    one, three = found
    assert torch.equal(one.report.dropped_mass, three.report.dropped_mass)
    assert all(torch.equal(one.samples.metadata[n], three.samples.metadata[n]) for n in one.samples.metadata)


# Colours -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(("channels", "width", "octaves"), [(3, 5, (0, 0)), (9, 32, (2, 2)), (4, 64, (4, 1))])
def test_shading_equals_the_colour_networks(monkeypatch, channels, width, octaves, shared):
    plan = random_field(4, True, seed=7).plan
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
    rays = bundle(*random_rays(plan, 60, seed=8))
    samples, _ = MMPISampler()(rays, field=field, threshold=0.0)
    assert samples.metadata["heads"].unique().numel() == 5
    with torch.no_grad():
        fast, plain = both(monkeypatch, lambda: next(iter(field.get_outputs(samples).values())))
    assert plain.std() > 0.05 and (fast - plain).abs().max() < 5e-6
    assert (fast[~samples.metadata["valid"][..., 0]] == 0).all()


def test_encoded_once_a_ray_or_once_a_sample_a_direction_gives_the_same_colour():
    networks = ColorNetworks(2, 4, 8, 2, 2)
    networks.weights.data = normal(*networks.weights.shape)
    features, ndc, directions, rays = normal(6, 4), normal(6, 3), normal(3, 3), torch.tensor([2, 0, 0, 1, 2, 2])
    once, each = networks(1, features, ndc, directions, rays), networks(1, features, ndc, directions[rays])
    assert torch.allclose(once, each, atol=1e-7)


def colour_batch(channels, width, octaves, count):
    """Networks and samples of one head; the samples of a ray follow each other, and some rays have many, some none."""
    networks = ColorNetworks(3, channels, width, *octaves)
    networks.weights.data = normal(*networks.weights.shape, seed=1) * 0.4
    g = torch.Generator().manual_seed(count)
    rays = (torch.rand(count, generator=g) ** 3 * 60).long().sort()[0]
    directions = torch.nn.functional.normalize(normal(60, 3, seed=2), dim=-1)
    return networks, normal(count, channels, seed=3), torch.rand(count, 3, generator=g) * 2 - 1, directions, rays


def colours_and_gradients(function, batch, dtype=torch.float32):
    networks, features, ndc, directions, rays = batch
    networks = copy.deepcopy(networks).to(dtype)
    features = features.detach().to(dtype).requires_grad_()
    found = function(networks, 1, features, ndc.to(dtype), directions.to(dtype), rays)
    (found * normal(len(rays), 3, seed=4).to(dtype)).sum().backward()
    return found.detach(), features.grad, networks.weights.grad


@pytest.mark.parametrize("count", [1, 33, 5000])
@pytest.mark.parametrize(
    ("channels", "width", "octaves"), [(3, 5, (0, 0)), (9, 32, (2, 2)), (17, 64, (4, 1)), (4, 40, (1, 0))]
)
def test_colours_and_their_gradients_equal_float64(channels, width, octaves, count):
    batch = colour_batch(channels, width, octaves, count)
    found = colours_and_gradients(colors, batch)
    wanted = colours_and_gradients(ColorNetworks.forward, batch, torch.float64)
    assert wanted[0].std() > 0.05
    for a, b in zip(found, wanted, strict=True):
        assert (a.double() - b).abs().max() < 2e-6 * (1 + b.abs().max())
    assert (wanted[2][1] != 0).float().mean() > 0.2 and not found[2][[0, 2]].any()


def test_gradients_of_colours_do_not_depend_on_the_number_of_threads():
    batch, threads, found = colour_batch(9, 32, (2, 2), 9000), torch.get_num_threads(), []
    for count in (1, 3):
        try:
            torch.set_num_threads(count)
            found.append(colours_and_gradients(colors, batch))
        finally:
            torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_one_ray_of_more_samples_than_a_part_has_all_its_gradient():
    networks, features, ndc, directions, rays = colour_batch(9, 32, (2, 2), 9000)
    batch = (networks, features, ndc, directions, torch.where(rays < 8, 2, rays).sort()[0])
    assert (batch[4] == 2).sum() > 2 * COLOUR_PART
    found = colours_and_gradients(colors, batch)
    for a, b in zip(found, colours_and_gradients(ColorNetworks.forward, batch, torch.float64), strict=True):
        assert (a.double() - b).abs().max() < 2e-6 * (1 + b.abs().max())


def test_colours_say_where_a_feature_is_not_a_number():
    networks, features, ndc, directions, rays = colour_batch(9, 32, (2, 2), 40)
    features[7, 5] = math.nan
    found, to_features, to_weights = colours_and_gradients(colors, (networks, features, ndc, directions, rays))
    assert found.isnan().any(-1).nonzero().flatten().tolist() == [7]
    assert to_features[7].isnan().all() and to_features.isnan().sum() == 9 and to_weights[1].isnan().any()


def test_colours_and_gradients_stay_float32_under_autocast():
    batch = colour_batch(9, 32, (2, 2), 300)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = colours_and_gradients(colors, batch)
    assert all(a.dtype == torch.float32 for a in found)
    assert (found[0] - colours_and_gradients(colors, batch)[0]).abs().max() < 0.03


def test_without_samples_colours_have_no_gradient():
    found = colours_and_gradients(colors, colour_batch(9, 32, (2, 2), 0))
    assert found[0].shape == (0, 3) and found[1].shape == (0, 9) and not found[2].any()


# Rows ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", ["side by side", "4096 apart", "anywhere"])
@pytest.mark.parametrize("count", [1, 7, 40_000])
def test_distinct_rows_are_those_of_the_reference(monkeypatch, count, spread):
    g, different = torch.Generator().manual_seed(count), 1 + count // 3
    chosen = torch.randint(0, different, (count, 4), generator=g)
    anywhere = torch.randint(0, 2**27, (different,), generator=g)
    rows = {"side by side": chosen, "4096 apart": chosen * 4096, "anywhere": anywhere[chosen]}[spread]
    fast, plain = both(monkeypatch, lambda: index_rows(rows))
    assert torch.equal(fast.unique, plain.unique)
    assert fast.position.shape == rows.shape and torch.equal(fast.unique[fast.position.long()], rows)


def test_numbers_too_large_for_a_table_are_sorted():
    rows = torch.tensor([2**40, 3, 2**40, 2**31])
    index = index_rows(rows)
    assert torch.equal(index.unique, torch.tensor([3, 2**31, 2**40]))
    assert torch.equal(index.unique[index.position.long()], rows)


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("channels", [1, 9])
def test_rows_gather_what_their_entries_give(monkeypatch, channels, weighted):
    rows = torch.randint(0, 40, (300, 4 if weighted else 1), generator=torch.Generator().manual_seed(1))
    values, weights = normal(300, channels), torch.rand(300, 4) if weighted else None

    def work():
        index = index_rows(rows)
        return torch.zeros(40, channels).index_copy_(0, index.unique, add_rows(index, values, weights))

    fast, plain = both(monkeypatch, work)
    assert plain.abs().max() > 1 and torch.allclose(fast, plain, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 9])
def test_gathered_rows_are_read_like_the_table_and_have_one_gradient_each(channels):
    rows, weights = torch.randint(0, 50, (80, 4), generator=torch.Generator().manual_seed(1)), torch.rand(80, 4)
    index = index_rows(rows)
    some, upstream = torch.arange(0, 80, 3), normal(80, channels, seed=2)
    table, plain = (normal(50, channels).requires_grad_() for _ in range(2))
    gathered = gather_rows(table, index.unique)
    read = interpolate_gathered(gathered, index.position, weights)
    part = interpolate_gathered(gathered, index.position[some], weights[some])
    wanted = interpolate_reference(plain, rows, weights)
    assert torch.allclose(read, wanted, atol=1e-6) and torch.allclose(part, wanted[some], atol=1e-6)
    ((read * upstream).sum() + 2 * part.sum()).backward()
    ((wanted * upstream).sum() + 2 * wanted[some].sum()).backward()
    assert torch.equal(table.grad._indices()[0], index.unique)
    assert torch.allclose(table.grad.to_dense(), plain.grad, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 9])
def test_variation_equals_the_reference_with_its_gradient(channels):
    cube = CubePlan((-1.0, -1.0, 2.0), (1.0, 1.0, 5.0), (3, 2, 4))
    plan = ScenePlan((make_mpi("a", height=5, width=4, planes=3), make_mpi("b", height=2, width=3)), cube, 0.05, 1.0)
    grids = MMPIField(plan).grids
    texels = torch.cat([g.rows for g in grids])
    table = normal(len(grids[0].places) * 64, channels) * 2
    rows = texels[torch.randperm(plan.texels, generator=torch.Generator().manual_seed(1))[: plan.texels - 9]]
    found = []
    for function in (total_variation, total_variation_reference):
        values = table[rows].requires_grad_()
        value = function(values, table, rows, grids, [(0.5, 2.0, 1.0), (1.0, 3.0, 0.3), (0.7, 1.0, 2.0)])
        (3 * value).backward()
        found.append((value.item(), values.grad))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5) and found[0][0] > 1
    assert torch.allclose(found[0][1], found[1][1], atol=1e-5)


@pytest.mark.parametrize("channels", [1, 9])
def test_variation_of_many_texels_does_not_depend_on_the_number_of_threads(channels):
    grids = make_grids([(3, 70, 60), (2, 50, 41)])
    table = normal(len(grids[0].places) * BRICK, channels) * 2
    rows = torch.cat([g.rows for g in grids]).sort()[0]
    assert len(rows) > 3 * PART
    found, threads = [], torch.get_num_threads()
    for count in (1, 3):
        values = table[rows].requires_grad_()
        try:
            torch.set_num_threads(count)
            value = total_variation(values, table, rows, grids, [(0.5, 2.0, 1.0), (1.0, 3.0, 0.3)])
            value.backward()
        finally:
            torch.set_num_threads(threads)
        found.append((value, values.grad))
    assert torch.equal(found[0][0], found[1][0]) and torch.equal(found[0][1], found[1][1])
    values = table[rows].double().requires_grad_()
    wanted = total_variation_reference(values, table.double(), rows, grids, [(0.5, 2.0, 1.0), (1.0, 3.0, 0.3)])
    wanted.backward()
    assert found[0][0].item() == pytest.approx(wanted.item(), rel=1e-6)
    assert torch.allclose(found[0][1].double(), values.grad, atol=2e-6)


def test_variation_says_where_a_texel_is_not_a_number():
    grids = make_grids([(2, 9, 9)])
    table = normal(len(grids[0].places) * BRICK, 9)
    broken = int(grids[0].row(torch.tensor([1]), torch.tensor([8]), torch.tensor([3])))
    table[broken, 4] = math.nan
    rows = grids[0].rows.sort()[0]
    values = table[rows].requires_grad_()
    value = total_variation(values, table, rows, grids, [(1.0, 1.0, 1.0)])
    value.backward()
    own = (rows == broken).nonzero().item()
    assert value.isnan() and values.grad[own, 4].isnan() and values.grad.isnan().sum() == 1 + 4, "and its neighbours"


def test_adam_on_rows_equals_the_plain_one_to_the_last_bits(monkeypatch):
    def work():
        param = torch.nn.Parameter(normal(500, 9))
        optimizer = TouchedAdam([param], lr=0.1)
        for step in range(6):
            rows = torch.randint(0, 500, (300,), generator=torch.Generator().manual_seed(step))
            values = normal(300, 9, seed=step)
            values[:, step] = 0  # entries without a gradient within a touched row
            param.grad = torch.sparse_coo_tensor(rows[None], values, param.shape)
            if step % 2:
                param.grad = param.grad.coalesce()
            optimizer.step()
        return param.data, optimizer.state[param]["exp_avg"], optimizer.state[param]["exp_avg_sq"]

    fast, plain = both(monkeypatch, work)
    assert (plain[0] - normal(500, 9)).abs().max() > 0.3
    for a, b in zip(fast, plain, strict=True):
        assert ((a - b).abs() <= 2e-6 * (1 + b.abs())).all()


# Where there are none ------------------------------------------------------------------------------------------------


@pytest.fixture
def unbuilt(monkeypatch, tmp_path):
    """A machine on which nothing has been compiled yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native._build.cache_clear()
    yield tmp_path
    native._build.cache_clear()


def test_without_a_compiler_plain_torch_runs_and_the_log_says_so(monkeypatch, unbuilt, capsys):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(native.shutil, "which", lambda name: None)
    field = random_field(2, seed=1)
    rays = bundle(*random_rays(field.plan, 10, seed=1))
    assert math.isfinite(render(field, rays).rgb.sum()) and native.library(torch.zeros(1)) is None
    render(field, rays)
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("no C++ compiler (g++ or clang++) is installed") == 1
    with pytest.raises(ValueError, match="no C\\+\\+ compiler"):
        native.choose("native")


def test_a_compiler_that_fails_is_named(monkeypatch, unbuilt, capsys):
    broken = unbuilt / "broken-compiler"
    broken.write_text("#!/bin/sh\necho 'no such flag' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CXX", str(broken))
    assert native.library(torch.zeros(1)) is None
    said = "".join(capsys.readouterr().out.split())
    assert "broken-compiler" in said and "nosuchflag" in said
    assert not list(unbuilt.glob("mmpi_ns/*.so"))


def test_what_was_compiled_is_used_again(monkeypatch, unbuilt):
    assert native.library(torch.zeros(1)) is not None
    assert [p.suffix for p in (unbuilt / "mmpi_ns").iterdir()] == [".so"]
    native._build.cache_clear()
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: pytest.fail("compiled twice"))
    assert native.library(torch.zeros(1)) is not None


def test_other_precisions_and_the_users_choice_take_the_plain_path():
    assert native.library(torch.zeros(1, dtype=torch.float64)) is None
    native.choose("torch")
    assert native.library(torch.zeros(1)) is None
