"""What rays show without gradients, by the Triton kernels: run like interpreted_march.py."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from bricked import bricked_field
from interpreting import by_torch, interpreted  # noqa: F401
from random_fields import OracleRay, _places, _table, bundle, random_field, random_rays

from mmpi_ns.ops.march import MarchOptions, gpu, reference
from mmpi_ns.ops.show import show_rays
from mmpi_ns.rendering.sampler import crossings


def shown(field, rays, threshold=0.0, form=None, shares=None):
    options = MarchOptions(threshold, form=form, baked=shares is not None)
    return show_rays(field.layout, field.tables(shares), field.features.data, crossings(rays, field), options)


def compare(field, rays, *how):
    """The kernels' sums are the reference's, but for rays with a sample whose weight is the threshold's."""
    found = shown(field, rays, *how)
    wanted = by_torch(lambda: shown(field, rays, *how))
    same = torch.ones(len(rays), dtype=torch.bool)
    for name, b in vars(wanted).items():
        a = getattr(found, name)
        assert a.shape == b.shape and torch.isfinite(a).all(), name
        same &= ((a - b).abs() <= 3e-5 * (1 + b.abs())).all(1)
    assert same.float().mean() >= 0.95
    return wanted


@pytest.mark.parametrize("form", ["paper", None])
@pytest.mark.parametrize("threshold", [0.0, 1e-2])
def test_rays_show_what_the_reference_says(monkeypatch, form, threshold):
    monkeypatch.setattr(reference, "OPAQUE_DEPTH", math.inf)  # the reference stops blending at 1e-4 of the light
    field = random_field(3, True, seed=3, planes=14)
    wanted = compare(field, bundle(*random_rays(field.plan, 40, seed=1)), threshold, form)
    assert len(wanted.winner.unique()) > 2 and wanted.gathered.abs().amax(0).min() > 0.05
    assert (wanted.dropped_mass > 1e-3).any() == (threshold > 0)


def test_thin_scenes_with_gaps_and_shares_at_texels_show_what_the_reference_says(monkeypatch):
    monkeypatch.setattr(gpu, "block_size", lambda wanted, device: 16)  # two programs, of different lengths
    field = bricked_field(0.4)
    rays = bundle(*random_rays(field.plan, 27, seed=1))
    wanted = compare(field, rays, 1e-3)
    assert (wanted.transmittance > 0.1).any()
    compare(field, rays, 1e-3, "paper", torch.rand(len(field.density), 1, generator=torch.Generator().manual_seed(1)))


def test_rays_show_what_float64_says():
    field, checked = random_field(3, True, seed=5, planes=10), 0
    origins, directions = random_rays(field.plan, 20, seed=6)
    found = shown(field, bundle(origins, directions), 0.0, "paper")
    for i in range(20):
        ray = OracleRay(field, origins[i], directions[i])
        if ray.margin < 1e-5:
            continue
        wanted, gathered, masses, checked = ray.render("paper"), np.zeros(5), np.zeros(4), checked + 1
        for weight, sample in zip(wanted.weights, wanted.samples, strict=True):
            ndc = _places(field.plan, origins[i], directions[i], sample.inverse_t)[sample.head]
            table = _table(field, field.features, sample.head)
            in_cube = sample.head == 3
            raw = oracle.trilinear(table, ndc) if in_cube else oracle.bilinear(table[sample.plane], *ndc[:2])
            gathered += weight * np.concatenate([1 / (1 + np.exp(-raw[:3])), np.tanh(raw[3:])])
            masses[sample.head] += weight
        assert np.abs(found.gathered[i].double().numpy() - gathered).max() < 5e-5
        assert found.mass[i].item() == pytest.approx(wanted.weights.sum(), abs=5e-5)
        assert found.accumulation[i].item() == pytest.approx(wanted.accumulation, abs=5e-5)
        assert found.transmittance[i].item() == pytest.approx(wanted.transmittance, abs=5e-5)
        half = np.abs(np.cumsum(wanted.weights) - 0.5 * wanted.weights.sum()).min() > 1e-4
        assert not half or found.inverse_t[i].item() == pytest.approx(wanted.median_inverse_distance, rel=1e-4)
        top = np.sort(masses)
        assert top[-1] - top[-2] < 1e-4 or int(found.winner[i]) == masses.argmax()
    assert checked > 10


def test_rays_that_meet_nothing_and_no_rays_show_nothing():
    field = random_field(2, seed=1)
    found = shown(field, bundle([[0, 0, 0], [0, 0, 0]], [[0, 0, 1], [0, 1, 0]], far=1e-3))
    assert (found.transmittance == 1).all() and all(
        (getattr(found, n) == 0).all() for n in ("gathered", "mass", "inverse_t")
    )
    assert shown(field, bundle(np.zeros((0, 3)), np.zeros((0, 3)))).gathered.shape == (0, 5)
