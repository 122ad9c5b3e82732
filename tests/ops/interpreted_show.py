"""What rays show without gradients, by the Triton kernels: run like interpreted_march.py."""

from __future__ import annotations

import math

import pytest
from bricked import bricked_field
from interpreting import interpreted  # noqa: F401
from random_fields import bundle, random_field, random_rays
from shows import as_float64_says, compare, nothing_is_shown_of_nothing

from mmpi_ns.ops.march import gpu


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize("threshold", [0.0, 1e-2])
def test_rays_show_what_the_reference_says(monkeypatch, blends, threshold):
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)  # the reference stops blending at 1e-4 of the light
    field = random_field(3, True, seed=3, planes=14)
    wanted = compare(field, bundle(*random_rays(field.plan, 40, seed=1)), threshold, blends)
    assert len(wanted.winner.unique()) > 2 and wanted.gathered.abs().amax(0).min() > 0.05
    assert (wanted.dropped_mass > 1e-3).any() == (threshold > 0)


def test_thin_scenes_with_gaps_show_what_the_reference_says(monkeypatch):
    monkeypatch.setattr(gpu, "block_size", lambda wanted, device: 16)  # two programs, of different lengths
    field = bricked_field(0.4)
    rays = bundle(*random_rays(field.plan, 27, seed=1))
    wanted = compare(field, rays, 1e-3)
    assert (wanted.transmittance > 0.1).any()
    compare(field, rays, 1e-3, True)


def test_rays_show_what_float64_says():
    assert as_float64_says(random_field(3, True, seed=5, planes=10), 20) > 10


def test_rays_that_meet_nothing_and_no_rays_show_nothing():
    nothing_is_shown_of_nothing()
