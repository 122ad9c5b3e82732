"""The dense reference that speed is measured against renders the same field."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mmpi_ns.bench import dense
from mmpi_ns.bench.regions import spearman
from mmpi_ns.bench.suites import SUITES
from mmpi_ns.mmpi_field import MMPIField
from mmpi_ns.mmpi_sampler import MMPISampler


def test_the_dense_reference_renders_what_the_sampler_renders(monkeypatch):
    torch.manual_seed(0)
    field = MMPIField(dense._plan().scaled(1 / 64), hidden_width=8, depth_scale=0.25)
    with torch.no_grad():
        field.density.normal_(std=3)
        field.features.normal_()
    bundle, _ = dense._batch(64)
    sampler = MMPISampler()
    whole = sampler.generate_ray_samples

    def keep_all(*args, **kwargs):
        return whole(*args, **{**kwargs, "threshold": 0.0})

    monkeypatch.setattr(sampler, "generate_ray_samples", keep_all)
    ours, _ = dense._ours(field, sampler, bundle, young=False)
    reference, _ = dense._dense(field, bundle)
    # The reference leaves out colours below alpha = 1e-4, so they may differ by that much a sample.
    assert float((ours - reference).abs().max()) < 5e-3
    assert float(ours.std()) > 0.05


def test_rows_of_a_suite_have_different_names():
    for variants in SUITES.values():
        keys = [(v.group, v.name) for v in variants]
        assert len(set(keys)) == len(keys)


def test_rank_correlation_asks_for_order_alone():
    a = np.array([3.0, 1.0, 2.0, 10.0])
    assert spearman(a, np.exp(a)) == pytest.approx(1)
    assert spearman(a, -a) == pytest.approx(-1)
    # Ties share their mean rank: ranks (1.5, 1.5, 3, 4) against (1, 2, 3, 4).
    assert spearman(np.array([5.0, 5.0, 6.0, 7.0]), np.arange(4.0)) == pytest.approx(0.9486832981)
