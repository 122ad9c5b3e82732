"""The parts of placement by themselves, against figures worked out by hand or by slow loops."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from seen_points import FX, FY, HEIGHT, WIDTH, mpi, observed, turned_about_y

from mmpi_ns.placement import candidates as candidates_module
from mmpi_ns.placement import rule
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


def test_what_is_weighed_of_many_keypoints_is_spread_over_all_depths():
    depth = np.random.default_rng(0).permutation(np.linspace(1, 100, 20_000))
    visible = find_visible_points(observed([[0.0, 0, 0]], -depth[:, None] * [0, 0, 1], np.zeros(20_000)))
    assert len(visible.points) == 6000 + 24
    kept = -visible.points[:6000, 2]
    assert np.quantile(kept, [0, 0.25, 0.5, 0.75, 1]) == pytest.approx([1, 25.75, 50.5, 75.25, 100], rel=1e-3)


def test_without_points_content_starts_at_a_tenth_of_the_cameras_spread():
    assert find_visible_points(observed([[0.0, 0, 0], [10, 0, 0]])).near == pytest.approx(0.5)


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


def test_candidates_start_from_cameras_far_apart_in_direction_too(monkeypatch):
    turns = turned_about_y(np.radians(45 * np.arange(8)))
    observations = observed(np.zeros((8, 3)), turns=turns)
    monkeypatch.setattr(candidates_module, "MAX_VIEWS", 4)
    names = {c.frame.name for c in find_candidates(observations, find_visible_points(observations))}
    assert np.diff(sorted(int(name.split()[1]) for name in names)).tolist() == [2, 2, 2]


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


def test_texel_error_takes_the_worse_side_and_each_side_its_own_focal_length():
    observations, point = observed([[0.0, 0, 0]]), np.array([[1.0, -0.5, -10.0]])
    zero = np.zeros(1, np.int64)
    wide, high = mpi(width=17), mpi(height=7)
    assert mpi_errors(wide, observations, zero, point)[1] == pytest.approx(1.6 / 16 * FX)
    assert mpi_errors(high, observations, zero, point)[1] == pytest.approx(1.2 / 6 * FY)


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


def test_what_two_better_ones_serve_makes_the_first_superfluous():
    both = candidate([3.0, 3, 3, 3], frame=marked(0))
    halves = [candidate([1.0, 1, 99, 99], frame=marked(1)), candidate([99.0, 99, 1, 1], frame=marked(2))]
    assert chosen([both])[0].name == "0"
    assert sorted(m.name for m in chosen([both, *halves])) == ["1", "2"]


def test_of_two_that_show_as_much_the_one_with_fewer_texels_is_taken():
    large, small = candidate(np.ones(4), rows=300.0, frame=marked(0)), candidate(np.ones(4), frame=marked(1))
    worse = candidate(np.full(4, 9.0), frame=marked(2))
    assert [m.name for m in chosen([large, small, worse])] == ["1"]


def test_where_all_candidates_show_everything_well_enough_one_is_taken():
    assert [m.name for m in chosen([candidate(np.ones(4), frame=marked(0))] * 2)] == ["0"]


def test_one_that_does_alone_takes_the_place_of_a_small_first_one_and_its_helper():
    small = candidate([1.0, 1, 1, 9], rows=60.0, frame=marked(0))
    helper = candidate([99.0, 99, 99, 1], rows=60.0, frame=marked(1))
    whole = candidate([1.0, 1, 1, 1.01], rows=75.0, frame=marked(2))
    names = [m.name for m in chosen([small, helper, whole], weight=1.0)]
    assert names == ["2"]
    too_large = candidate([1.0, 1, 1, 1.01], rows=90.0, frame=marked(2))
    assert sorted(m.name for m in chosen([small, helper, too_large], weight=1.0)) == ["0", "1"]


@pytest.mark.parametrize("finest", [3.1, 1000.0])
def test_the_finest_texels_within_the_budget_are_kept_and_the_coarsest_where_none_is(monkeypatch, finest):
    """Texels here are few from a size on; of the eight attempts the last is too fine again."""
    tried = []

    class Few:
        def __init__(self, candidates, weights, config, texel_pixels):
            tried.append(texel_pixels)

        def heads(self, texel_pixels):
            side = 10 if texel_pixels >= finest else 100
            return [mpi(planes=2, height=side, width=side)]

    monkeypatch.setattr(rule, "_Choice", Few)
    monkeypatch.setattr(rule, "widened", lambda mpis, *_: mpis)
    observations = orbit()
    config = PlacementConfig(max_texels=2000, texel_pixels=1.5)
    (head,), spans = rule._choose(observations, find_visible_points(observations), config, 1.5)
    if finest < 100:
        assert head.texels == 200 and len(tried) == rule.BUDGET_ROUNDS and tried[-1] < finest
        assert finest <= spans < rule.FINER * finest
    else:
        assert head.texels == 20000 and spans == tried[-1] == max(tried) > 10.0


def test_texels_in_all_follow_the_settings_and_the_rays_whichever_allow_fewer():
    config = PlacementConfig(max_texels=2000)
    wanted = {None: 2000, 1000: 2000, 100: 800}
    scene = side_by_side(1), find_visible_points(side_by_side(1))
    assert {rays: rule.texel_limits(*scene, config, rays)[1] for rays in wanted} == wanted
    assert rule.texel_limits(*scene, replace(config, max_texels=0), 1000)[1] == 8000
    assert rule.texel_limits(*scene, replace(config, max_texels=0), None)[1] == 0


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


def test_texels_are_as_fine_as_the_rays_of_all_images_that_see_them_train():
    config = PlacementConfig(rays_per_texel=5)
    spans = {}
    for count in (1, 4, 16):
        observations = side_by_side(count)
        rays = 0.1 * observations.sizes.prod(-1).sum()  # one ray for ten pixels
        spans[count], _ = rule.texel_limits(observations, find_visible_points(observations), config, rays)
    assert list(spans.values()) == pytest.approx([50**0.5, 12.5**0.5, 3.125**0.5], rel=0.01)
    assert rule.texel_limits(observations, find_visible_points(observations), config, None)[0] == 0


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


def test_mpis_at_one_camera_have_different_names(monkeypatch):
    monkeypatch.setattr(rule, "_choose", lambda *_: ([marked(7), marked(7)], 2.0))
    assert place(orbit(), PlacementConfig()).names == ("7 (0)", "7 (1)")


def test_rays_start_at_a_fifth_of_the_way_to_the_content():
    observations = orbit()
    plan = rule.place(observations, PlacementConfig())
    near = find_visible_points(observations).near
    assert 2 < near < 4 and plan.content_near == near and plan.ray_near == pytest.approx(near / 5)
