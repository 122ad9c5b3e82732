"""The oracle on rays worked out by hand, and the pure modules together against the oracle."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
from hand_made import make_mpi


def test_oracle_crosses_planes_where_geometry_says():
    mpi = make_mpi(near=1.0, planes=3, extent=(-1.2, 1.2, -1.0, 1.0))  # depths 1, 2, infinity
    found = oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8])
    assert found.live.tolist() == [False, True, True]
    assert found.u.tolist() == pytest.approx([1.5, 1.125, 0.75])
    assert found.inverse_t.tolist() == pytest.approx([1 / 2.5, 1 / 3.75, 0])
    assert oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8], far=4.0).live.tolist() == [False, True, False]
    assert oracle.crossings(mpi, [0, 0, -1], [0.6, 0, 0.8], near=3.8).live.tolist() == [False, False, True]


def test_oracle_renders_two_planes_by_hand():
    near, far = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    both = np.ones(2, bool)
    samples = [
        [oracle.RaySample(0, 0, 0.5, math.log(2), near, np.array([0.0, 0.0]), both)],
        [oracle.RaySample(1, 0, 1.0, math.log(4), far, np.array([0.0, math.log(3)]), both)],
    ]
    ray = oracle.render_ray(samples)
    # The second head is nearer: alpha' = 3/4 * 3/4; then alpha' = 1/2 * 1/2.
    assert ray.weights.tolist() == pytest.approx([9 / 16, 7 / 16 / 4])
    assert ray.color.tolist() == pytest.approx([7 / 64, 9 / 16, 0])
    assert ray.transmittance == pytest.approx(21 / 64) and ray.median_inverse_distance == 1.0
    assert oracle.render_ray(samples, False).transmittance == pytest.approx(1 / 8)
