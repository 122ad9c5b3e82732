"""What the march keeps, by the compiled form at hand, against plain torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from compiled import both
from hand_made import make_mpi, unit
from random_fields import bundle, render, sampled

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.scene.plan import CubePlan, ScenePlan


def compare(field, rays, threshold, blends=False, least=0.95, ndc=2e-6, inverse_t=3e-5, tau=2e-5):
    """The march's samples are the reference's to these errors; returns its rendering and the reference's."""
    fast, plain = both(lambda: render(field, rays, threshold, blends))
    # A sample whose weight is the threshold's to the last bits may fall on either side of it.
    same = torch.eq(*(m.samples.starts.diff() for m in (fast, plain)))
    assert same.float().mean() >= least
    columns = {"heads": 0, "planes": 0, "ndc": ndc, "inverse_t": inverse_t, "tau": tau, "skipped_before": 2e-5}
    for name, error in columns.items():
        a, b = (getattr(m.samples, name)[same[m.samples.rays]] for m in (fast, plain))
        assert a.dtype == b.dtype and ((a - b).abs() <= error * (1 + b.abs())).all(), name
    assert torch.equal(fast.samples.num_intersected, plain.samples.num_intersected)
    assert torch.equal(fast.samples.fully_covered, plain.samples.fully_covered)
    difference = (fast.samples.dropped_mass - plain.samples.dropped_mass)[same]
    if difference.numel():
        assert difference.min() > -2e-6 and difference.max() < 1.2e-5, "what is not visited counts as dropped"
        assert (fast.composite.transmittance - plain.composite.transmittance).abs().max() < 1.2e-5
        assert (fast.rgb - plain.rgb).abs()[same].max() < 3e-5
    return fast, plain


def behind_an_opaque_plane_nothing_is_visited_and_a_hundred_thousandth_is_lost():
    field = MMPIField(ScenePlan((make_mpi(planes=64),), None, 0.05, 1.0)).eval()
    field.density.data[field.grids[0].rows[: 10 * field.grids[0].height * field.grids[0].width]] = 30.0
    actual = render(field, bundle([[0, 0, 0]], [[0, 0, 1]]), threshold=1e-3)
    assert actual.samples.num_intersected.item() == 64 and actual.samples.starts.tolist() == [0, 1]
    assert actual.samples.skipped_total.item() == 0 and actual.samples.dropped_mass.item() <= 1e-5
    assert actual.composite.accumulation.item() == pytest.approx(1, abs=1e-5)


def nothing_is_marched_without_rays_or_samples():
    field = MMPIField(ScenePlan((make_mpi(),), None, 0.05, 1.0)).eval()
    away = render(field, bundle([[0, 0, 0]], [[0, 0, -1]]), blends=True)
    assert away.samples.starts.tolist() == [0, 0] and away.composite.accumulation.item() == 0
    _, samples = sampled(field, bundle(torch.zeros(0, 3), torch.zeros(0, 3)), 1e-3)
    assert samples.starts.tolist() == [0] and samples.num_intersected.shape == (0,)


# Rays that are hard to march, through a scene in which every distance is a tie ---------------------------------------


def hard_plan():
    """Two MPIs that coincide, one that ends, and a cube."""
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


def hard_rays():
    """All of them, as a bundle."""
    origins, directions = (np.array(x, float) for x in zip(*HARD_RAYS.values(), strict=True))
    return bundle(origins, np.stack([unit(d) for d in directions]))
