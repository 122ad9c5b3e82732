"""The compiled plane hits against their reference in float64, on random rays and on hard ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from compiled import compiled  # noqa: F401
from hand_made import make_mpi, random_mpi

from mmpi_ns.ops import dispatch, hits
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene import geometry
from mmpi_ns.scene.geometry import Frames

NAMES = ("u", "v", "local_origins", "local_directions")


def found_and_wanted(mpis, origins, directions, near=0.05, far=math.inf):
    rays = [torch.tensor(np.asarray(x), dtype=torch.float32).reshape(-1, 3) for x in (origins, directions)]
    bounds = [torch.full((len(rays[0]), 1), float(x)) for x in (near, far)]
    assert dispatch.form_of("plane_hits", *rays) == "cpu"
    found = hits.plane_hits(*rays, *bounds, SceneLayout(tuple(mpis), Frames.pack(mpis), [], []))
    exact = [x.double() for x in (*rays, *bounds)]
    return found, geometry.plane_hits(*exact, Frames.pack(mpis, dtype=torch.float64))


@pytest.mark.parametrize("far", [math.inf, 4.0])
def test_random_rays_hit_the_planes_of_the_reference(far):
    rng = np.random.default_rng(1)
    mpis = [random_mpi(rng, str(k), planes=20 + k) for k in range(5)]
    origins, directions = rng.normal(size=(4000, 3)), rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    found, wanted = found_and_wanted(mpis, origins, directions, 0.05, far)
    hit = wanted.count > 0
    # A plane may be crossed at a border to the last bits.
    same = (found.count == wanted.count) & ((found.m_first == wanted.m_first) | ~hit)
    assert hit.float().mean() > 0.1 and same.float().mean() > 0.999
    assert (found.count - wanted.count).abs().max() <= 1
    for name in NAMES:
        a, b = getattr(found, name)[hit].double(), getattr(wanted, name)[hit]
        assert ((a - b).abs() <= 2e-5 * (1 + b.abs())).all(), name


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
    found, wanted = found_and_wanted(mpis, origin, direction)
    assert torch.equal(found.count, wanted.count)
    hit = wanted.count > 0
    assert torch.equal(found.m_first[hit], wanted.m_first[hit])
    assert all(torch.allclose(getattr(found, n)[hit].double(), getattr(wanted, n)[hit], atol=1e-6) for n in NAMES)


def test_rays_that_are_not_numbers_and_no_rays_hit_nothing():
    mpis = [make_mpi()]
    assert not found_and_wanted(mpis, (0, 0, 0), (math.nan, math.nan, math.nan))[0].count.any()
    assert found_and_wanted(mpis, np.zeros((0, 3)), np.zeros((0, 3)))[0].count.shape == (0, 1)
