"""The exact reference of the benchmarks against the tests' own oracle, and its gradients against finite differences."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
from hand_made import random_mpi, random_votes, unit
from random_fields import OracleRay, random_field, random_rays
from stability import exact
from stability.exact_ray import ExactField, ExactRay, Gradients


def test_crossings_equal_the_oracle():
    rng = np.random.default_rng(0)
    for i in range(150):
        mpi, origin, direction = random_mpi(rng), rng.normal(size=3) * 3, unit(rng.normal(size=3))
        near, far = rng.uniform(0, 2), [math.inf, 9.0][i % 2]
        found, wanted = (
            exact.cross(mpi, origin, direction, near, far),
            oracle.crossings(mpi, origin, direction, near, far),
        )
        clear = np.array([c.margin for c in wanted]) > 1e-12
        live = np.array([c.live for c in wanted])
        assert (found.live == live)[clear].all()
        both = live & found.live
        for name in ("u", "v", "inverse_t"):
            expected = np.array([getattr(c, name) for c in wanted])
            assert np.allclose(getattr(found, name)[both], expected[both], rtol=1e-9, atol=1e-12)


def test_points_far_and_at_infinity_lie_where_the_oracle_says():
    rng = np.random.default_rng(1)
    for _ in range(100):
        mpi, origin, direction = random_mpi(rng), rng.normal(size=3) * 3, unit(rng.normal(size=3))
        inverse_t = float(rng.choice([0.0, 10 ** rng.uniform(-6, 0)]))
        found, wanted = (
            exact.place_in(mpi, origin, direction, inverse_t),
            oracle.ray_point_to_ndc(mpi, origin, direction, inverse_t),
        )
        assert (found is None) == (wanted is None)
        assert found is None or np.allclose(found[0], wanted, rtol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_blending_equals_the_oracle_and_has_its_differences(scale):
    rng = np.random.default_rng(2)
    reliability, cover, own = random_votes(rng, 60, 4, scale)
    for r, c, o, tau in zip(reliability, cover, own, 10 ** rng.uniform(-6, 2, 60), strict=True):
        made = exact.blend(tau, r, c, o, True)
        assert made.depth == pytest.approx(oracle.blended_depth(tau, r, c, o), rel=1e-14, abs=1e-300)
        every, rest = exact.shares(r, c, int(o))
        log_share, log_rest = oracle.log_shares(r, c, o)
        assert float(every[o].ln()) == pytest.approx(log_share, rel=1e-14)
        assert rest == 0 if math.isinf(log_rest) else float(rest.ln()) == pytest.approx(log_rest, rel=1e-14)
        if scale > 1:
            continue
        h = 1e-6
        differences = [
            (oracle.blended_depth(tau, r + h * e, c, o) - oracle.blended_depth(tau, r - h * e, c, o)) / 2 / h
            for e in np.eye(4)
        ]
        assert np.allclose(made.by_reliability, differences, rtol=1e-6, atol=1e-8)
        h = 1e-4 * tau
        slope = (oracle.blended_depth(tau + h, r, c, o) - oracle.blended_depth(tau - h, r, c, o)) / 2 / h
        assert made.by_tau == pytest.approx(slope, rel=1e-5)


def test_compositing_equals_the_oracle_and_has_its_differences():
    rng = np.random.default_rng(3)
    taus = rng.exponential(0.4, 30)
    made, wanted = exact.composite(taus), oracle.composite(taus)
    assert np.allclose(made.weights, wanted.weights, rtol=1e-12)
    assert made.transmittance == pytest.approx(wanted.transmittance, rel=1e-12)
    assert made.accumulation == pytest.approx(wanted.accumulation, rel=1e-12)
    by_weight, by_transmittance = rng.normal(size=30), 0.7

    def value(t):
        c = oracle.composite(t)
        return by_weight @ c.weights + by_transmittance * c.transmittance

    h = 1e-6
    differences = [(value(taus + h * e) - value(taus - h * e)) / 2 / h for e in np.eye(30)]
    assert np.allclose(exact.composite_gradient(taus, by_weight, by_transmittance), differences, atol=1e-8)


def test_biases_give_every_plane_an_equal_weight():
    biases, interval = exact.plane_bias(48)
    weights = exact.composite(exact.softplus(biases) * interval).weights
    assert np.allclose(weights, 1 / 48, rtol=2e-3) and np.allclose(weights[:-1], 1 / 48, rtol=1e-12)


@pytest.mark.parametrize("blends", [True, False])
@pytest.mark.parametrize("with_cube", [False, True])
def test_whole_rays_equal_the_oracle(with_cube, blends):
    field = random_field(3, with_cube, seed=1)
    field.touched[::3] = 0
    known, met = ExactField.of(field), 0
    for origin, direction in zip(*random_rays(field.plan, 6, seed=2), strict=True):
        found, wanted = ExactRay(known, origin, direction), OracleRay(field, origin, direction)
        if wanted.margin < 1e-9:
            continue
        expected = wanted.render(blends)
        color, made = found.render(blends)
        assert [(s.head, s.plane) for s in found.samples] == [(s.head, s.plane) for s in expected.samples]
        assert np.allclose(made.weights, expected.weights, atol=1e-10)
        assert np.allclose(color, expected.color, atol=1e-10)
        met += len(expected.samples) > 0
    assert met >= 4


@pytest.mark.parametrize("blends", [True, False])
def test_gradients_of_a_whole_ray_are_its_finite_differences(blends):
    field = random_field(2, True, seed=4)
    known = ExactField.of(field)
    origin, direction = (x[0] for x in random_rays(field.plan, 1, seed=5))
    by_color, total = np.array([1.0, -0.7, 0.4]), Gradients(known)
    ExactRay(known, origin, direction).add_gradient(by_color, blends, total)
    checked = 0
    for name in ("density", "features", "reliability", "networks"):
        for table, gradient in zip(known.tables[name], total.sums[name], strict=True):
            strongest = np.argsort(-np.abs(gradient), axis=None)[:4]
            for index in (np.unravel_index(i, table.shape) for i in strongest):
                values = []
                for move in (1e-5, -2e-5):
                    table[index] += move
                    values.append(by_color @ ExactRay(known, origin, direction).render(blends)[0])
                table[index] += 1e-5
                assert gradient[index] == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-4, abs=1e-7)
                checked += abs(gradient[index]) > 1e-4
    assert checked >= (20 if blends else 14)
