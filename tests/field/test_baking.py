"""Shares baked at texels: against the oracle."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from hand_made import make_mpi
from random_fields import _places, _table, fill, random_field

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.texels import BRICK
from mmpi_show.windows import bake_shares


def oracle_share(field, k, z, y, x):
    """P of one texel in float64, and how close a decision was."""
    grid, plan = field.grids[k], field.plan
    ndc = np.array([2 * i / (n - 1) - 1 for i, n in zip((x, y, z), (grid.width, grid.height, grid.depth), strict=True)])
    point, far = oracle.ndc_to_world(plan.mpis[k], ndc)
    places = _places(plan, np.zeros(3), point, 0.0 if far else 1.0)
    votes, cover, margin = np.zeros(len(places)), np.zeros(len(places), bool), math.inf
    for j, place in enumerate(places):
        if j == k:
            place, cover[j] = ndc, True
        elif place is None:
            continue
        else:
            margin = min(margin, float(np.abs(np.abs(place) - 1).min()))
            touched = _table(field, field.touched, j)[..., 0]
            at = [(c + 1) / 2 * (n - 1) for c, n in zip(place[::-1], touched.shape, strict=True)]
            margin = min([margin, *(abs(a % 1 - 0.5) for a in at)])
            nearest = tuple(min(max(round(a), 0), n - 1) for a, n in zip(at, touched.shape, strict=True))
            cover[j] = bool((np.abs(place) <= 1).all()) and bool(touched[nearest])
        votes[j] = oracle.lookup(_table(field, field.reliability, j), np.clip(place, -1, 1))[0]
    return math.exp(oracle.log_shares(votes, cover, k)[0]), margin


def test_every_texel_has_the_share_that_the_oracle_has():
    field, rng = random_field(3, False, seed=7, planes=9), np.random.default_rng(0)
    field.touched.copy_(torch.tensor(rng.uniform(size=len(field.touched)) < 0.8))
    shares, checked, seen = bake_shares(field), 0, set()
    for _ in range(300):
        k = int(rng.integers(len(field.grids)))
        grid = field.grids[k]
        z, y, x = (int(rng.integers(n)) for n in (grid.depth, grid.height, grid.width))
        wanted, margin = oracle_share(field, k, z, y, x)
        if margin < 1e-5:
            continue
        row = int(grid.row(*(torch.tensor([i]) for i in (z, y, x))))
        assert float(shares[row]) == pytest.approx(wanted, abs=2e-5), (k, z, y, x)
        checked, seen = checked + 1, seen | {round(wanted, 3)}
    assert checked > 200 and len(seen) > 30
    assert (shares[:BRICK] == 1).all(), "nothing is stored there"


def test_rays_to_texels_lose_nothing_far_from_the_worlds_origin():
    far = (3e6, -2e6, 1e6)
    plan = ScenePlan((make_mpi(origin=far), make_mpi("twin", origin=(far[0] + 0.5, far[1], far[2]))), None, 0.05, 1.0)
    near = ScenePlan((make_mpi(), make_mpi("twin", origin=(0.5, 0.0, 0.0))), None, 0.05, 1.0)
    there, here = (bake_shares(fill(MMPIField(p, feature_channels=5, hidden_width=6), 3)) for p in (plan, near))
    assert torch.allclose(there, here, atol=1e-5) and here.std() > 0.1


def test_shares_that_are_the_same_everywhere_are_baked_as_they_are():
    """Two equal frusta that believe in nothing more than in each other: P is 1/2 at every place."""
    field = fill(MMPIField(ScenePlan((make_mpi(), make_mpi("twin")), None, 0.05, 1.0), feature_channels=5), 1)
    field.reliability.data.fill_(0.7)
    shares = bake_shares(field)
    for grid in field.grids:
        assert torch.allclose(shares[grid.rows], torch.tensor(0.5), atol=1e-6)


def test_a_single_head_has_all():
    assert (bake_shares(random_field(1, seed=2)) == 1).all()
