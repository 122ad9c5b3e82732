"""The compiled march against its reference in plain torch."""

from __future__ import annotations

import math

import pytest
import torch
from compiled import both, compiled  # noqa: F401
from hand_made import make_mpi
from random_fields import bundle, random_field, random_rays, render, sampled

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.scene.plan import ScenePlan


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize(("num_mpis", "with_cube"), [(1, False), (4, True), (9, False)])
@pytest.mark.parametrize("threshold", [0.0, 1e-3, 3e-2])
def test_the_march_keeps_what_the_reference_keeps(monkeypatch, num_mpis, with_cube, blends, threshold):
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)  # the reference stops blending at 1e-4 of the light
    field = random_field(num_mpis, with_cube, seed=num_mpis, planes=40)
    rays = bundle(*random_rays(field.plan, 200, seed=1))
    fast, plain = both(lambda: render(field, rays, threshold, blends))
    kept, wanted = vars(fast.samples), vars(plain.samples)
    # A sample whose weight is the threshold's to the last bits may fall on either side of it.
    same = kept["valid"].sum(1) == wanted["valid"].sum(1)
    assert same.float().mean() > 0.98 and wanted["valid"].any()
    width = min(kept["valid"].shape[1], wanted["valid"].shape[1])
    valid = wanted["valid"][same, :width]
    for name, error in (("heads", 0), ("planes", 0), ("ndc", 1e-5), ("inverse_t", 1e-4), ("tau", 3e-5)):
        a, b = (m[name][same, :width][valid].double() for m in (kept, wanted))
        assert ((a - b).abs() <= error * (1 + b.abs())).all(), name
    assert torch.allclose(
        kept["skipped_before"][same, :width][valid], wanted["skipped_before"][same, :width][valid], atol=2e-5
    )
    for name in ("heads", "planes", "ndc", "inverse_t", "tau", "skipped_before"):
        assert (kept[name][~kept["valid"]] == 0).all(), "empty slots are 0"
    assert torch.equal(fast.samples.live, plain.samples.live)
    assert (fast.composite.transmittance - plain.composite.transmittance).abs().max() < 1.2e-5
    difference = fast.samples.dropped_mass - plain.samples.dropped_mass
    assert difference[same].min() > -2e-6 and difference[same].max() < 1.2e-5, "what is not visited counts as dropped"
    assert (fast.rgb - plain.rgb).abs()[same].max() < 3e-5


def test_behind_an_opaque_plane_the_march_visits_nothing_and_loses_a_hundred_thousandth():
    field = MMPIField(ScenePlan((make_mpi(planes=64),), None, 0.05, 1.0)).eval()
    field.density.data[field.grids[0].rows[: 10 * field.grids[0].height * field.grids[0].width]] = 30.0
    found = render(field, bundle([[0, 0, 0]], [[0, 0, 1]]), threshold=1e-3)
    assert found.samples.live.item() == 64 and found.samples.valid.sum() == 1
    assert found.samples.skipped_total.item() == 0 and found.samples.dropped_mass.item() <= 1e-5
    assert found.composite.accumulation.item() == pytest.approx(1, abs=1e-5)


def test_without_rays_or_samples_there_is_nothing_to_march():
    field = MMPIField(ScenePlan((make_mpi(),), None, 0.05, 1.0)).eval()
    away = render(field, bundle([[0, 0, 0]], [[0, 0, -1]]), blends=True)
    assert away.samples.valid.sum() == 0 and away.composite.accumulation.item() == 0
    _, samples = sampled(field, bundle(torch.zeros(0, 3), torch.zeros(0, 3)), 1e-3)
    assert samples.valid.shape[0] == 0 and samples.live.shape == (0,)


def test_results_do_not_depend_on_the_number_of_threads():
    field = random_field(4, True, seed=5, planes=40)
    rays, threads = bundle(*random_rays(field.plan, 1200, seed=6)), torch.get_num_threads()
    found = []
    for count in (1, 3):
        try:
            torch.set_num_threads(count)
            found.append(render(field, rays, 1e-3, True))
        finally:
            torch.set_num_threads(threads)
    one, three = found
    assert torch.equal(one.samples.dropped_mass, three.samples.dropped_mass)
    tensors = [n for n, x in vars(one.samples).items() if isinstance(x, torch.Tensor)]
    assert all(torch.equal(getattr(one.samples, n), getattr(three.samples, n)) for n in tensors)
