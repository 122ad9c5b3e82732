"""What rays show without gradients, compiled: sixteen rays side by side against plain torch and float64."""

from __future__ import annotations

import math

import pytest
import torch
from bricked import bricked_field
from compiled import compiled  # noqa: F401
from fused import as_float64_says, compare, no_rays_give_empty_outputs, rendered
from hand_made import make_mpi
from marches import hard_plan, hard_rays
from random_fields import bundle, random_field, random_rays

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import dispatch
from mmpi_ns.scene.plan import ScenePlan


@pytest.fixture(autouse=True)
def side_by_side(monkeypatch):
    assert dispatch.form_of("render_fused", torch.zeros(1)) == "cpu"
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)  # the reference stops blending at T = 1e-4


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize(("num_mpis", "with_cube"), [(1, False), (4, True), (9, False)])
@pytest.mark.parametrize("threshold", [0.0, 1e-3, 3e-2])
def test_rays_show_what_the_reference_says(num_mpis, with_cube, blends, threshold):
    """Of more planes than a word has bits."""
    field = random_field(num_mpis, with_cube, seed=num_mpis, planes=70)
    wanted = compare(field, bundle(*random_rays(field.plan, 200, seed=1)), threshold, blends)
    assert len(wanted.winner.unique()) > 0.8 * num_mpis and wanted.gathered.abs().amax(0).min() > 0.05
    assert (wanted.dropped_mass > 1e-3).any() == (threshold > 0)


@pytest.mark.parametrize("blends", [True, False])
def test_rays_show_what_float64_says(blends):
    assert as_float64_says(random_field(3, True, seed=5, planes=10), 20, blends) > 10
    assert as_float64_says(random_field(1, seed=8, planes=40), 20, blends) > 10


@pytest.mark.parametrize("share", [0.0, 0.02, 0.4, 0.9])
def test_what_is_passed_over_holds_nothing(share):
    """Tiles in no order, of which so many are stored; planes of which the last tiles are cut off."""
    field = bricked_field(share)
    rays = bundle(*random_rays(field.plan, 300, seed=1))
    wanted = compare(field, rays, 1e-3)
    assert (wanted.mass > 0.1).any() == (share > 0) and (wanted.transmittance > 0.1).any()
    compare(field, rays, 1e-3, True)
    compare(field, rays, 1e-6)


@pytest.mark.parametrize("raw", [0.0, 1e4, -1e4])
def test_hard_rays_through_thin_and_opaque_planes(raw):
    field = MMPIField(hard_plan(), feature_channels=5, hidden_width=6).eval()
    field.reliability.data.normal_(generator=torch.Generator().manual_seed(1))
    field.features.data.normal_(generator=torch.Generator().manual_seed(2))
    field.density.data.fill_(raw)
    field.touched.fill_(1)
    for blends, threshold in ((False, 0.0), (False, 1e-3), (True, 1e-3)):
        # Places on planes that a ray runs along are known to 1e-3 of a texel.
        wanted = compare(field, hard_rays(), threshold, blends, error=1e-3)
        assert (wanted.mass > 0.5).any() == (raw >= 0)


def test_rays_do_not_see_their_neighbours():
    """Whatever their number, their order and the threads, each shows what it shows alone, to the bit."""
    field = random_field(3, True, seed=5, planes=40)
    origins, directions = random_rays(field.plan, 700, seed=6)
    whole, threads = rendered(field, bundle(origins, directions), 1e-3, True), torch.get_num_threads()
    parts = [rendered(field, bundle(origins[p], directions[p]), 1e-3, True)
             for p in (slice(0, 1), slice(1, 18), slice(18, 700))]  # fmt: skip
    turned = rendered(field, bundle(origins[::-1].copy(), directions[::-1].copy()), 1e-3, True)
    try:
        torch.set_num_threads(2)
        halves = rendered(field, bundle(origins, directions), 1e-3, True)
    finally:
        torch.set_num_threads(threads)
    for name, values in vars(whole).items():
        assert torch.equal(values, torch.cat([getattr(p, name) for p in parts])), name
        assert torch.equal(values, getattr(turned, name).flip(0)) and torch.equal(values, getattr(halves, name)), name


def test_behind_an_opaque_plane_nothing_is_read_and_a_hundred_thousandth_is_lost():
    field = MMPIField(ScenePlan((make_mpi(planes=64),), None, 0.05, 1.0)).eval()
    behind = field.grids[0].rows[10 * field.grids[0].height * field.grids[0].width :]
    field.density.data[field.grids[0].rows] = 30.0
    field.density.data[behind], field.features.data[behind] = math.nan, math.nan
    actual = rendered(field, bundle([[0, 0, 0]], [[0, 0, 1]]), 1e-3)
    assert actual.accumulation.item() == pytest.approx(1, abs=1e-5) and actual.gathered.isfinite().all()
    assert 0 < actual.dropped_mass.item() <= 1e-5


def test_after_growth_and_release_rays_pass_other_tiles():
    """What is known of the tiles belongs to one layout."""
    field = bricked_field(0.6)
    rays = bundle(*random_rays(field.plan, 100, seed=1))
    before = rendered(field, rays, 1e-3)
    field._keep(torch.rand(field.num_bricks + 1, generator=torch.Generator().manual_seed(3)) < 0.5)
    after = compare(field, rays, 1e-3)
    assert (before.mass - after.mass).abs().max() > 0.1


def test_rays_that_meet_nothing_and_no_rays_show_nothing():
    no_rays_give_empty_outputs()
