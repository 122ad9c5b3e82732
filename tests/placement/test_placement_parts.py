"""The parts of placement by themselves, against figures worked out by hand or by slow loops."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from seen_points import FX, FY, HEIGHT, WIDTH, mpi, observed, turned_about_y

from mmpi_ns.placement.candidates import Candidate, find_candidates
from mmpi_ns.placement.errors import PixelErrors, cube_errors, mpi_errors
from mmpi_ns.placement.observations import Observations, find_visible_points, pixels_per_pixel
from mmpi_ns.placement.rule import PlacementConfig, _Choice, place
from mmpi_ns.scene.plan import CubePlan


def test_content_starts_for_each_camera_where_its_own_points_do():
    depths = [np.linspace(10, 20, 40), np.linspace(100, 200, 40), np.full(5, 40.0)]
    centers = np.array([[0.0, 0, 0], [30, 0, 0], [60, 0, 0]])
    points = np.concatenate([c - d[:, None] * [0, 0, 1] for c, d in zip(centers, depths, strict=True)])
    visible = find_visible_points(observed(centers, points, np.repeat([0, 1, 2], [40, 40, 5])))
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
    observations = observed([[0.0, 0, 0], [30, 0, 0]], [[0, 0, -d] for d in depths], np.repeat([0, 1], 40))
    visible = find_visible_points(observations)
    assert visible.near == 55
    found = {(c.frame.name, c.frame.origin[2]): c.frame.near for c in find_candidates(observations, visible)}
    assert found == pytest.approx({
        ("view 1", 0.0): 6, ("view 1", 55.0): 61, ("view 1", 110.0): 116,
        ("view 2", 0.0): 33, ("view 2", 55.0): 88, ("view 2", 110.0): 143,
    })  # fmt: skip


def orbit(inwards: int = 16) -> Observations:
    """Sixteen cameras on a circle of radius 4; so many look at keypoints around its centre, the others away from it."""
    turns = turned_about_y(2 * np.pi * np.arange(16) / 16)
    centers = 4 * turns[:, :, 2]
    turns[inwards:] *= [-1, 1, -1]
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    return observed(centers, points, np.repeat(np.arange(inwards), 40), np.tile(np.arange(40), inwards), turns)


def test_a_candidates_errors_are_those_of_the_mpi_made_of_it():
    observations = orbit()
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


def test_a_cubes_error_is_the_longest_side_of_a_voxel_at_the_points_depth():
    observations = observed([[0.0, 0, 4]])
    cube = CubePlan((-1.0, -2.0, -3.0), (1.0, 2.0, 3.0), (10, 40, 20))  # z, y, x: voxels of 0.1, 0.1, 0.6
    points = np.array([[0.5, 1.5, -1.0], [0.5, 1.5, 2.0], [0.5, 2.1, 2.0]])
    found = cube_errors(cube, observations, np.zeros(3, np.int64), points)
    assert found == pytest.approx([0.6 * FX / 5, 0.6 * FX / 2, np.inf])


def test_both_errors_count_as_one_and_the_smallest_decides_which_head_serves_best():
    inf = math.inf
    errors = PixelErrors(
        np.array([[3.0, 0.0], [9.0, 4.0], [inf, 1.0], [inf, inf]]),
        np.array([[8.0, 12.0], [0.0, 6.0], [inf, 2.0], [inf, inf]]),
    )
    assert errors.combined[:2] == pytest.approx(np.array([[5, 6], [9, 5]]))
    assert errors.combined[:3].argmin(-1).tolist() == [0, 1, 1]


# The choice, among candidates made by hand ---------------------------------------------------------------------------


def candidate(texel, plane=None, rows=100.0, frame=None) -> Candidate:
    """What it costs each observation: pixels of a texel, and of two planes."""
    texel = np.asarray(texel, np.float32)
    plane = np.zeros(len(texel), np.float32) if plane is None else np.asarray(plane, np.float32)
    return Candidate(frame or mpi(), rows, rows, plane, texel)


def chosen(candidates, weight=10.0, **changes):
    """The heads, with texels of two pixels, planes for one pixel, and so much weight for every observation."""
    config = PlacementConfig(plane_pixels=0.5, texel_pixels=2.0, **changes)
    return _Choice(candidates, np.full(len(candidates[0].texel), weight), config, 2.0).heads(2.0)


def marked(number):
    return mpi(name=str(number))


def test_planes_are_as_many_as_four_fifths_of_what_is_served_ask_for():
    error = np.random.default_rng(0).permutation(np.arange(101.0))  # 80 at four fifths, one pixel is allowed
    assert chosen([candidate(np.ones(101), error)])[0].planes == 80
    assert chosen([candidate(np.ones(101), 20 * error)])[0].planes == PlacementConfig().max_planes
    assert chosen([candidate(np.ones(101), 0.01 * error)])[0].planes == 16
    assert chosen([candidate(np.ones(101), 20 * error)], max_planes=64)[0].planes == 64


def side_by_side(count: int, depths=(-10.0,)) -> Observations:
    """Cameras within a millimetre of each other that see the same points, or as far apart that none shares any."""
    points = np.array([[0.01 * x, 0.01 * y, z] for z in depths for x in range(5) for y in range(5)])
    centers = [[0.001 * i, 0, 0] for i in range(count)]
    return observed(centers, np.tile(points, (count, 1)), np.arange(count).repeat(len(points)))


def test_pixels_that_see_a_pixels_content_are_those_of_all_images_by_their_magnification():
    random = np.random.default_rng(3)
    centers = random.uniform([-6, -3, -2], [6, 3, 2], (7, 3))
    points = random.uniform([-4, -2, -14], [4, 2, -8], (40, 3))
    cameras, numbers = np.divmod(np.arange(280), 40)
    offset = points[numbers] - centers[cameras]
    seen = (np.abs(offset[:, 0] * FX) < -offset[:, 2] * WIDTH / 2) & (
        np.abs(offset[:, 1] * FY) < -offset[:, 2] * HEIGHT / 2
    )
    observations = observed(centers, points[numbers[seen]], cameras[seen])
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


@pytest.mark.parametrize(
    ("changes", "rays", "words"),
    [
        ({}, 10**9, "2.0 pixels: finer with a smaller placement.texel-pixels"),
        ({}, 2000, " pixels: finer with more steps"),
        ({"max_texels": 2e4}, 10**9, " pixels: finer with a larger placement.max-texels"),
    ],
)
def test_a_plan_says_how_large_texels_are_and_what_makes_them_finer(changes, rays, words):
    config = replace(PlacementConfig(texel_pixels=2.0, max_texels=0), **changes)
    plan = place(side_by_side(4), config, rays)
    assert plan.origin_of_plan.startswith("automatic placement, a texel spans ") and words in plan.origin_of_plan
    numbers = [float(n) for n in re.findall(r"(?:spans|down to) ([\d.]+)", plan.origin_of_plan)]
    assert plan.detail == pytest.approx((numbers[0] / numbers[-1]) ** 2, rel=0.1) and numbers[-1] >= 2.0
    assert (plan.detail > 1) == (len(numbers) == 2) == ("max_texels" in changes)


def test_a_short_training_gets_a_small_plan():
    random = np.random.default_rng(0)
    points = random.uniform([-8, -4, -40], [8, 4, -6], (300, 3))
    cameras = observed(
        [[x, y, 0] for x in range(3) for y in range(3)], np.tile(points, (9, 1)), np.arange(9).repeat(300)
    )
    config = PlacementConfig(rays_per_texel=0)
    texels = {rays: place(cameras, config, rays).texels for rays in (2_000, 20_000, None)}
    assert 12_000 < texels[2_000] <= 16_000 and 120_000 < texels[20_000] <= 160_000 < texels[None]
