"""The compiled march against its reference in plain torch."""

from __future__ import annotations

import math

import pytest
import torch
from compiled import compiled  # noqa: F401
from marches import (
    behind_an_opaque_plane_nothing_is_visited_and_a_hundred_thousandth_is_lost,
    compare,
    nothing_is_marched_without_rays_or_samples,
)
from random_fields import bundle, random_field, random_rays, render


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize(("num_mpis", "with_cube"), [(1, False), (4, True), (9, False)])
@pytest.mark.parametrize("threshold", [0.0, 1e-3, 3e-2])
def test_the_march_keeps_what_the_reference_keeps(monkeypatch, num_mpis, with_cube, blends, threshold):
    monkeypatch.setattr("mmpi_ns.sampler.OPAQUE_DEPTH", math.inf)  # the reference stops blending at T = 1e-4
    field = random_field(num_mpis, with_cube, seed=num_mpis, planes=40)
    rays = bundle(*random_rays(field.plan, 200, seed=1))
    _, plain = compare(field, rays, threshold, blends, least=0.98, ndc=1e-5, inverse_t=1e-4, tau=3e-5)
    assert len(plain.samples.heads)


def test_behind_an_opaque_plane_the_march_visits_nothing():
    behind_an_opaque_plane_nothing_is_visited_and_a_hundred_thousandth_is_lost()


def test_without_rays_or_samples_there_is_nothing_to_march():
    nothing_is_marched_without_rays_or_samples()


def test_results_do_not_depend_on_the_number_of_threads():
    field = random_field(4, True, seed=5, planes=40)
    rays, threads = bundle(*random_rays(field.plan, 1200, seed=6)), torch.get_num_threads()
    actual = []
    for count in (1, 3):
        try:
            torch.set_num_threads(count)
            actual.append(render(field, rays, 1e-3, True))
        finally:
            torch.set_num_threads(threads)
    one, three = actual
    assert torch.equal(one.samples.dropped_mass, three.samples.dropped_mass)
    tensors = [n for n, x in vars(one.samples).items() if isinstance(x, torch.Tensor)]
    assert all(torch.equal(getattr(one.samples, n), getattr(three.samples, n)) for n in tensors)
