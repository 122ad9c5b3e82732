"""The planes that the compiled march crosses, against ``geometry.plane_hits`` in float64, on random and hard rays."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from compiled import compiled  # noqa: F401
from hand_made import make_mpi

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.march import MarchOptions, Rays
from mmpi_ns.sampler import march
from mmpi_ns.scene import geometry
from mmpi_ns.scene.geometry import Frames, inverse_distance, sample_disparity
from mmpi_ns.scene.plan import ScenePlan


def found_and_wanted(mpis, origins, directions, near=0.05, far=math.inf):
    """First plane and number of planes of every ray in every MPI [R, K], and of every sample that both have its place
    on the plane and its inverse distance [N, 3]."""
    rays = [torch.tensor(np.asarray(x), dtype=torch.float32).reshape(-1, 3) for x in (origins, directions)]
    bounds = [torch.full((len(rays[0]), 1), float(x)) for x in (near, far)]
    field, frames = MMPIField(ScenePlan(tuple(mpis), None, near, 1.0)), Frames.pack(mpis, dtype=torch.float64)
    m = march(field.layout, field.tables, Rays(*rays, *bounds), MarchOptions(0.0))
    wanted = geometry.plane_hits(*(x.double() for x in (*rays, *bounds)), frames)
    number = frames.num_planes[m.heads] - 1 - m.planes
    count, none = torch.zeros_like(wanted.count), torch.full_like(wanted.count, -1)
    count.index_put_((m.rays, m.heads), torch.ones_like(number), accumulate=True)
    first = none.view(-1).scatter_reduce(0, m.rays * len(mpis) + m.heads, number, "amax").view(none.shape)
    assert torch.equal(m.num_intersected, count.sum(1)) and torch.equal(m.fully_covered[:, 0], count.sum(1) > 0)
    ray, head = m.rays, m.heads
    w = sample_disparity(number, frames.disparity_steps[head], frames.last_disparities[head])
    low, high = frames.extents[head][:, 0::2], frames.extents[head][:, 1::2]
    at = torch.stack([x[ray, head, 0] + w * x[ray, head, 1] for x in (wanted.u, wanted.v)], -1)
    o, d = wanted.local_origins[ray, head, 2], wanted.local_directions[ray, head, 2]
    places = torch.cat([2 * (at - low) / (high - low) - 1, inverse_distance(w, o, d)[:, None]], -1)
    actual = torch.cat([m.ndc[:, :2], m.inverse_t[:, None]], -1).double()
    return SimpleNamespace(count=count, m_first=first, places=actual), SimpleNamespace(**vars(wanted), places=places)


@pytest.mark.parametrize(
    ("origin", "direction"),
    [
        ((0, 0, 0), (0, 0, 1)),  # along the axis
        ((0, 0, 0), (0, 0, -1)),  # away
        ((0, 0, 0), (1, 0, 0)),  # along the planes
        ((0, 0, 0), (1, 0, 1e-7)),  # as good as along the planes
        ((0, 0, 1.0), (0, 0, 1)),  # from the nearest plane
        ((0, 0, 50.0), (0, 0, 1)),  # from behind all finite planes
        ((0.3, 0.1, 0.5), (0.1, -0.2, 0.97)),
        ((9, 0, 0), (0, 0, 1)),  # beside
    ],
)
def test_hard_rays_hit_the_planes_of_the_reference(origin, direction):
    mpis = [make_mpi(planes=9), make_mpi("b", (0.2, 0.0, -1.0), planes=5)]
    actual, wanted = found_and_wanted(mpis, origin, direction)
    assert torch.equal(actual.count, wanted.count)
    hit = wanted.count > 0
    assert torch.equal(actual.m_first[hit], wanted.m_first[hit])
    assert torch.allclose(actual.places, wanted.places, atol=2e-6)


def test_rays_that_are_not_numbers_and_no_rays_hit_nothing():
    mpis = [make_mpi()]
    assert not found_and_wanted(mpis, (0, 0, 0), (math.nan, math.nan, math.nan))[0].count.any()
    for origin in ((math.nan, 0, 0), (0, 0, math.nan), (math.inf, 0, 0), (0, 0, -math.inf)):
        assert not found_and_wanted(mpis, origin, (0, 0, 1))[0].count.any()
    assert found_and_wanted(mpis, np.zeros((0, 3)), np.zeros((0, 3)))[0].count.shape == (0, 1)
