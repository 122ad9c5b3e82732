"""What rays show without gradients, by the compiled form at hand, against plain torch and against float64."""

from __future__ import annotations

import numpy as np
import oracle
import pytest
import torch
from random_fields import OracleRay, _places, _table, bundle, random_field, random_rays

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.sampler import rays_of, render_fused


def rendered(field, rays, threshold=0.0, blends=False, **chosen):
    """What rays show, whatever heads may answer them."""
    options = MarchOptions(threshold, blends=blends)
    return render_fused(field.layout, field.tables, field.features.data, rays_of(rays, **chosen), options)


def compare(field, rays, *how, error=3e-5, **chosen):
    """The kernels' sums are the reference's, but for rays with a sample whose weight is the threshold's."""
    actual = rendered(field, rays, *how, **chosen)
    with dispatch.chosen("torch"):
        wanted = rendered(field, rays, *how, **chosen)
    same = torch.ones(len(rays), dtype=torch.bool)
    for name, b in vars(wanted).items():
        a = getattr(actual, name)
        assert a.shape == b.shape and torch.isfinite(a).all(), name
        same &= ((a - b).abs() <= error * (1 + b.abs())).all(1)
    assert same.float().mean() >= 0.95
    return wanted


def as_float64_says(field, count, blends=True):
    """Checks rays that no decision is close on; returns how many those are."""
    origins, directions = random_rays(field.plan, count, seed=6)
    actual, checked = rendered(field, bundle(origins, directions), 0.0, blends), 0
    for i in range(count):
        ray = OracleRay(field, origins[i], directions[i])
        if ray.margin < 1e-5:
            continue
        wanted, gathered, masses, checked = ray.render(blends), np.zeros(5), np.zeros(len(field.grids)), checked + 1
        for weight, sample in zip(wanted.weights, wanted.samples, strict=True):
            ndc = _places(field.plan, origins[i], directions[i], sample.inverse_t)[sample.head]
            table = _table(field, field.features, sample.head)
            in_cube = sample.head == len(field.plan.mpis)
            raw = oracle.lookup(table, ndc) if in_cube else oracle.lookup(table[sample.plane], ndc[:2])
            gathered += weight * np.concatenate([1 / (1 + np.exp(-raw[:3])), np.tanh(raw[3:])])
            masses[sample.head] += weight
        assert np.abs(actual.gathered[i].double().numpy() - gathered).max() < 5e-5
        assert actual.mass[i].item() == pytest.approx(wanted.weights.sum(), abs=5e-5)
        assert actual.accumulation[i].item() == pytest.approx(wanted.accumulation, abs=5e-5)
        assert actual.transmittance[i].item() == pytest.approx(wanted.transmittance, abs=5e-5)
        half = np.abs(np.cumsum(wanted.weights) - 0.5 * wanted.weights.sum()).min() > 1e-4
        assert not half or actual.inverse_t[i].item() == pytest.approx(wanted.median_inverse_distance, rel=1e-4)
        top = np.sort(masses)
        assert len(top) < 2 or top[-1] - top[-2] < 1e-4 or int(actual.winner[i]) == masses.argmax()
    return checked


def no_rays_give_empty_outputs():
    """Rays that meet nothing, and no rays."""
    field = random_field(2, seed=1)
    actual = rendered(field, bundle([[0, 0, 0], [0, 0, 0]], [[0, 0, 1], [0, 1, 0]], far=1e-3))
    assert (actual.transmittance == 1).all() and all(
        (getattr(actual, n) == 0).all() for n in ("gathered", "mass", "inverse_t", "accumulation", "dropped_mass")
    )
    assert rendered(field, bundle(np.zeros((0, 3)), np.zeros((0, 3)))).gathered.shape == (0, 5)
