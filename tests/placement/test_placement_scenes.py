"""What automatic placement does on procedural scenes, and what must not change its mind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from procedural import moved, observations_of
from still_life import still_life

from mmpi_ns.placement.candidates import find_candidates
from mmpi_ns.placement.errors import WORST, mpi_errors
from mmpi_ns.placement.observations import Observations, find_visible_points
from mmpi_ns.placement.rule import ENOUGH, place
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.settings import PlacementConfig
from mmpi_scene.catalogue import make_scene

CONFIG = PlacementConfig(max_texels=0)
"""As fine as asked."""


def facing(plan: ScenePlan) -> np.ndarray:
    return np.array([m.axes[2] for m in plan.mpis])


@pytest.fixture(scope="module")
def street() -> Observations:
    return observations_of(make_scene("street"), per_camera=30)


@pytest.fixture(scope="module")
def street_plan(street) -> ScenePlan:
    return place(street, CONFIG)


def bits(plan: ScenePlan, observations: Observations, config: PlacementConfig = CONFIG) -> float:
    """Expected error that a plan leaves, in bits, summed over images: the rule's own aim, worked out afresh."""
    visible = find_visible_points(observations)
    errors = [mpi_errors(m, observations, visible.cameras, visible.points) for m in plan.mpis]
    least = np.min([np.hypot(plane, 0.5 * texel) for plane, texel in errors], axis=0)
    enough = ENOUGH * config.texel_pixels
    return float(np.log2(np.clip(least, enough, WORST) / enough) @ visible.weights)


def test_a_forward_facing_grid_gets_one_mpi():
    plan = place(observations_of(still_life()), CONFIG)
    assert len(plan.mpis) == 1


def test_a_straight_street_gets_mpis_one_further_on_than_the_other_and_nothing_behind(street, street_plan):
    forward = street.mean_axes[2]
    places = np.array([m.origin for m in street_plan.mpis]) @ forward
    driven = np.ptp(street.centers @ forward)
    assert 3 <= len(street_plan.mpis) <= 8
    assert (facing(street_plan) @ forward > -0.2).all()
    assert np.ptp(places) > 0.4 * driven


def test_looking_round_from_one_spot_gets_mpis_all_round():
    observations = observations_of(make_scene("look-round"), per_camera=30)
    plan = place(observations, CONFIG)
    level = facing(plan)[:, :2]
    level = level[np.linalg.norm(level, axis=-1) > 0.5]
    azimuth = np.sort(np.degrees(np.arctan2(level[:, 1], level[:, 0])))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 360))
    assert len(plan.mpis) >= 5
    assert gaps.max() < 125  # an MPI is up to 90 degrees wide and the cameras' views overlap


def test_mpis_grow_with_the_length_of_a_road():
    def mpis(length):
        road = observations_of(make_scene("long-road", length=length), per_camera=12)
        return len(place(road, replace(CONFIG, max_mpis=1000)).mpis)

    short, long = mpis(200.0), mpis(500.0)
    assert 1.7 <= long / short <= 3.3


def test_a_moved_scene_gets_the_moved_plan(street, street_plan):
    q, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    turn = q * np.sign(np.linalg.det(q))
    shift, scale = np.array([100.0, -7.0, 3.0]), 0.037
    plan = place(moved(street, turn, shift, scale), CONFIG)
    assert len(plan.mpis) == len(street_plan.mpis)
    assert plan.content_near == pytest.approx(scale * street_plan.content_near, rel=1e-6)
    for got, wanted in zip(plan.mpis, street_plan.mpis, strict=True):
        assert got.name == wanted.name and got.planes == wanted.planes
        assert (got.height, got.width) == (wanted.height, wanted.width)
        assert np.allclose(got.origin, scale * (turn @ wanted.origin) + shift, atol=1e-6)
        assert np.allclose(got.axes, np.asarray(wanted.axes) @ turn.T, atol=1e-9)
        assert got.near == pytest.approx(scale * wanted.near, rel=1e-6)
        assert np.allclose(got.extent, wanted.extent)


def test_gross_outliers_change_little(street, street_plan):
    rng = np.random.default_rng(5)
    points = street.points.copy()
    wrong = rng.choice(len(points), len(points) // 10, replace=False)
    camera = street.seen_by[np.unique(street.seen_point, return_index=True)[1]][: len(wrong)]
    directions = points[wrong] - street.centers[camera]
    points[wrong] = street.centers[camera] + directions * np.exp(rng.uniform(-3, 3, (len(wrong), 1)))
    plan = place(replace(street, points=points), CONFIG)
    assert abs(len(plan.mpis) - len(street_plan.mpis)) <= 2
    assert plan.content_near == pytest.approx(street_plan.content_near, rel=0.25)
    assert bits(plan, street) < bits(street_plan, street) + 0.15 * len(street.centers)


def test_every_chosen_mpi_is_needed_and_no_other_would_add_enough(street, street_plan):
    whole = bits(street_plan, street)
    for k in range(len(street_plan.mpis)):
        rest = tuple(m for i, m in enumerate(street_plan.mpis) if i != k)
        assert bits(replace(street_plan, mpis=rest), street) > whole + 0.5 * CONFIG.min_gain
    finest = replace(street_plan, mpis=tuple(replace(m, planes=CONFIG.max_planes) for m in street_plan.mpis))
    floor = bits(finest, street)
    visible = find_visible_points(street)
    for candidate in find_candidates(street, visible)[::7]:
        mpi = candidate.at(CONFIG.texel_pixels, CONFIG.max_planes)
        assert bits(replace(finest, mpis=(*finest.mpis, mpi)), street) > floor - 1.1 * CONFIG.min_gain
