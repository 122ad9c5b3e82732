"""Borders that MPIs are widened to, and the table of a plan, against figures worked out by hand or by slow loops."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from seen_points import FX, FY, HEIGHT, WIDTH, mpi, observed, turned_about_y

from mmpi_ns.placement.errors import WORST, pixel_errors
from mmpi_ns.placement.observations import Observations, find_visible_points
from mmpi_ns.placement.rule import PlacementConfig, place, widened
from mmpi_ns.placement.show import explain, table
from mmpi_ns.scene.plan import CubePlan, ScenePlan


def test_a_border_goes_to_the_mpi_that_must_grow_least_and_texels_keep_their_size_both_ways():
    observations = observed([[0.0, 0, 0]], [[0.0, 0, -10]] * 30, np.zeros(30))
    whole = (-WIDTH / 2 / FX, WIDTH / 2 / FX, -HEIGHT / 2 / FY, HEIGHT / 2 / FY)
    close, narrow = mpi(extent=whole), mpi(extent=tuple(0.7 * x for x in whole))
    got = widened([narrow, close], observations, find_visible_points(observations))
    assert got[0] == narrow
    assert got[1].extent == pytest.approx([1.1 * x for x in whole])
    assert (got[1].height - 1) / (close.height - 1) == pytest.approx(1.1, rel=0.01)
    far = replace(close, near=11.0)  # begins behind the content, so it holds none of it
    got = widened([narrow, far], observations, find_visible_points(observations))
    assert got[1] == far and got[0].extent == pytest.approx([1.1 * x for x in whole])


def test_only_one_side_that_is_missing_is_widened():
    observations = observed([[0.0, 0, 0]], [[0.0, 0, -10]] * 30, np.zeros(30))
    (got,) = widened([mpi(extent=(-2.0, 2.0, -0.3, 2.0))], observations, find_visible_points(observations))
    assert got.extent == pytest.approx([-2, 2, -0.55, 2]) and got.width == 81
    assert got.height == round(60 * 2.55 / 2.3) + 1


def looking_aside(degrees) -> Observations:
    turns = turned_about_y([np.radians(degrees)])
    return observed([[0.0, 0, 0]], np.tile(-10 * turns[0][:, 2], (30, 1)), np.zeros(30), turns=turns)


def test_nothing_is_widened_far_or_beyond_the_widest_tangent():
    # Border points lie at -1.1, -0.55, 0, ... times 2/3 from the image's middle, whose tangent is -1.73 here.
    observations = looking_aside(60)
    (got,) = widened([mpi(extent=(-0.6, 0.6, -3.0, 3.0))], observations, find_visible_points(observations))
    aside = np.tan(np.radians(60) - np.arctan(1.1 / 3))
    assert got.extent == pytest.approx([-aside, 0.6, -3, 3])  # -0.83; -1.73 would be too far
    wide, middle = mpi(extent=(-2.9, 0.6, -3.0, 3.0)), looking_aside(np.degrees(np.arctan(2.95)))
    assert widened([wide], middle, find_visible_points(middle))[0].extent[0] == pytest.approx(-2.95)
    middle = looking_aside(np.degrees(np.arctan(3.05)))
    assert widened([wide], middle, find_visible_points(middle)) == [wide]


def test_the_table_says_what_a_slow_count_finds():
    rng = np.random.default_rng(2)
    centers = np.array([[0.0, 0, 0], [1.0, 0, -2], [0.5, 0, -5]])
    points = np.stack([rng.uniform(-6, 6, 90), rng.uniform(-3, 3, 90), rng.uniform(-40, -8, 90)], -1)
    observations = observed(centers, points, np.repeat([0, 1, 2], 30))
    visible = find_visible_points(observations)
    heads = (
        mpi(extent=(-0.3, 0.3, -0.3, 0.3)),
        mpi(name="right", origin=(1.0, 0.0, -2.0), extent=(-0.1, 0.5, -0.4, 0.4), planes=12),
    )
    plan = ScenePlan(heads, CubePlan((-6.0, -3.0, -25.0), (6.0, 3.0, -9.0), (20, 30, 40)), 0.1, 1.0)
    report, errors = (
        explain(plan, observations, visible),
        pixel_errors(plan, observations, visible.cameras, visible.points),
    )
    total, own, holders, best_errors = sum(visible.weights), [[], [], []], 0.0, []
    for q, row in enumerate(errors.combined.tolist()):
        held = [k for k in range(3) if row[k] < math.inf]
        holders += len(held) * visible.weights[q]
        best_errors.append(min(*row, WORST))
        if held:
            own[min(held, key=lambda k: row[k])].append(q)
    assert min(map(len, own)) >= 5 and sum(map(len, own)) < len(visible.weights)
    for k in range(3):
        rest = [min([WORST, *(e for j, e in enumerate(errors.combined[q]) if j != k)]) for q in own[k]]
        assert report.shares[k] == pytest.approx(sum(visible.weights[q] for q in own[k]) / total)
        assert report.error_with[k] == pytest.approx(np.median([min(errors.combined[q][k], WORST) for q in own[k]]))
        assert report.error_without[k] == pytest.approx(np.median(rest)) and np.median(rest) > report.error_with[k]
    assert report.unserved == pytest.approx(1 - sum(visible.weights[q] for qs in own for q in qs) / total)
    assert report.overlap == pytest.approx(holders / total)
    lines = table(plan, observations, report).splitlines()
    assert [line.split(" | ")[5] for line in lines[2:5]] == ["33 x 61 x 81", "12 x 61 x 81", "20 x 30 x 40"]
    ordered, last = sorted(best_errors), len(best_errors) - 1
    said = lines[-1]
    assert f"Expected error {np.median(ordered):.2f} px in the median" in said
    between = ordered[int(0.9 * last)] + (0.9 * last % 1) * (ordered[int(0.9 * last) + 1] - ordered[int(0.9 * last)])
    assert f"{between:.2f} px at nine tenths" in said


@pytest.mark.parametrize("arrangement", ["room", "drive"])
def test_hand_made_mpis_have_the_rows_and_columns_that_are_asked_for(arrangement):
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)) - [0, 0, 8.0]
    cameras = observed([[0.0, 0, 0], [1, 0, 0]], points, np.repeat([0, 1], 25))
    plan = place(cameras, PlacementConfig(arrangement=arrangement, planes=5, height=8, width=12))
    assert {(m.planes, m.height, m.width) for m in plan.mpis} == {(5, 8, 12)}
