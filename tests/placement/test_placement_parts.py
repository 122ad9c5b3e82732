"""The parts of placement by themselves, against figures worked out by hand or by slow loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hand_made import observed

from mmpi_ns.placement.candidates import find_candidates
from mmpi_ns.placement.errors import mpi_errors
from mmpi_ns.placement.observations import Observations, find_visible_points, pixels_per_pixel
from mmpi_ns.placement.rule import widened
from mmpi_ns.scene.plan import MPIPlan

FX, FY, WIDTH, HEIGHT = 150.0, 100.0, 200, 100
AXES = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Of an MPI that looks as a camera without rotation does: along -z, y up."""


def seen_from(centers, points, seen_by, seen_point=None, turns=None) -> Observations:
    """By cameras that look along -z unless turned."""
    turns = np.tile(np.eye(3), (len(centers), 1, 1)) if turns is None else turns
    poses = np.concatenate([turns, np.array(centers, np.float64)[:, :, None]], -1)
    return observed(poses, [FX, FY, WIDTH / 2, HEIGHT / 2], [WIDTH, HEIGHT], points, seen_by, seen_point)


def test_content_starts_for_each_camera_where_its_own_points_do():
    depths = [np.linspace(10, 20, 40), np.linspace(100, 200, 40), np.full(5, 40.0)]
    centers = np.array([[0.0, 0, 0], [30, 0, 0], [60, 0, 0]])
    points = np.concatenate([c - d[:, None] * [0, 0, 1] for c, d in zip(centers, depths, strict=True)])
    visible = find_visible_points(seen_from(centers, points, np.repeat([0, 1, 2], [40, 40, 5])))
    assert visible.near == pytest.approx(55)  # the median of 10 and 100; the third camera has too few of its own
    assert visible.nearest == pytest.approx([10, 100, 55])
    # The third takes the quantiles of all 85: the 22nd, and 0.6 beyond the 31st of the second's.
    assert visible.typical == pytest.approx(
        np.array([[12.5, 19], [125, 190], [10 + 21 * 10 / 39, 100 + 30.6 * 100 / 39]])
    )
    assert np.bincount(visible.cameras, visible.weights) == pytest.approx([1, 1, 1])
    # 0.85 of the weight at most, and half of that for ten keypoints.
    assert visible.weights[:85] == pytest.approx(np.array([0.85 / 50, 0.85 / 50, 0.85 / 15])[visible.cameras[:85]])


def test_planes_begin_a_little_before_the_content_of_the_camera_or_of_all_where_that_is_nearer():
    depths = np.repeat([10.0, 100.0], 40)
    observations = seen_from([[0.0, 0, 0], [30, 0, 0]], [[0, 0, -d] for d in depths], np.repeat([0, 1], 40))
    visible = find_visible_points(observations)
    assert visible.near == 55
    actual = {(c.frame.name, c.frame.origin[2]): c.frame.near for c in find_candidates(observations, visible)}
    assert actual == pytest.approx({
        ("view 1", 0.0): 6, ("view 1", 55.0): 61, ("view 1", 110.0): 116,
        ("view 2", 0.0): 33, ("view 2", 55.0): 88, ("view 2", 110.0): 143,
    })  # fmt: skip


def test_a_candidates_errors_are_those_of_the_mpi_made_of_it():
    """Sixteen cameras on a circle of radius 4 look at keypoints around its centre."""
    angles, points = 2 * np.pi * np.arange(16) / 16, np.random.default_rng(0).uniform(-1, 1, (40, 3))
    turns = np.array([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in angles])
    seen_by, seen_point = np.divmod(np.arange(16 * 40), 40)
    observations = seen_from(4 * turns[:, :, 2], points, seen_by, seen_point, turns)
    visible = find_visible_points(observations)
    candidates = find_candidates(observations, visible)
    seen = 0
    for candidate in candidates[::17]:
        head = candidate.at(0.5, 40)
        plane, texel = mpi_errors(head, observations, visible.cameras, visible.points)
        assert (head.extent[1] - head.extent[0]) / (head.width - 1) == pytest.approx(0.5 / FX, rel=0.01)
        assert (head.extent[3] - head.extent[2]) / (head.height - 1) == pytest.approx(0.5 / FY, rel=0.01)
        held = np.isfinite(texel)
        assert np.array_equal(np.isfinite(candidate.texel), held)
        assert candidate.plane[held] / 39 == pytest.approx(plane[held], rel=1e-4, abs=1e-6)
        assert 0.5 * candidate.texel[held] == pytest.approx(texel[held], rel=0.02)
        seen += held.sum()
    assert seen > 50


def test_pixels_that_see_a_pixels_content_are_those_of_all_images_by_their_magnification():
    random = np.random.default_rng(3)
    centers = random.uniform([-6, -3, -2], [6, 3, 2], (7, 3))
    points = random.uniform([-4, -2, -14], [4, 2, -8], (40, 3))
    cameras, numbers = np.divmod(np.arange(280), 40)
    offset = points[numbers] - centers[cameras]
    seen = (np.abs(offset[:, 0] * FX) < -offset[:, 2] * WIDTH / 2) & (
        np.abs(offset[:, 1] * FY) < -offset[:, 2] * HEIGHT / 2
    )
    observations = seen_from(centers, points[numbers[seen]], cameras[seen])
    visible = find_visible_points(observations)
    covered = []
    for camera, point in zip(visible.cameras, visible.points, strict=True):
        total = 0.0
        for center in centers:
            x, y, z = point - center
            if z < 0 and abs(FX * x / z) <= WIDTH / 2 and abs(FY * y / z) <= HEIGHT / 2:
                total += ((point - centers[camera])[2] / z) ** 2
        covered.append(total)
    order = np.argsort(covered)
    share = np.cumsum(visible.weights[order]) / visible.weights.sum()
    assert pixels_per_pixel(observations, visible) == pytest.approx(max(1, covered[order[(share >= 0.25).argmax()]]))
    assert 1.2 < pixels_per_pixel(observations, visible) < 7


def test_a_border_goes_to_the_mpi_that_must_grow_least_and_texels_keep_their_size_both_ways():
    observations = seen_from([[0.0, 0, 0]], [[0.0, 0, -10]] * 30, np.zeros(30))
    whole = (-WIDTH / 2 / FX, WIDTH / 2 / FX, -HEIGHT / 2 / FY, HEIGHT / 2 / FY)
    close = MPIPlan("front", (0.0, 0.0, 0.0), AXES, 2.0, whole, 33, 61, 81)
    narrow = replace(close, extent=tuple(0.7 * x for x in whole))
    got = widened([narrow, close], observations, find_visible_points(observations))
    assert got[0] == narrow
    assert got[1].extent == pytest.approx([1.1 * x for x in whole])
    assert (got[1].height - 1) / (close.height - 1) == pytest.approx(1.1, rel=0.01)
    far = replace(close, near=11.0)  # begins behind the content, so it holds none of it
    got = widened([narrow, far], observations, find_visible_points(observations))
    assert got[1] == far and got[0].extent == pytest.approx([1.1 * x for x in whole])
