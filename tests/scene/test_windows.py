"""Long captures: split into windows, whose shares change along the way; read window by window."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_made import make_mpi, observed
from training_runs import datamanager, schedule_of

from mmpi_ns.placement.defaults import FEW, MANY, RAYS, rays_times, steps_for
from mmpi_ns.placement.observations import Observations
from mmpi_ns.placement.split import cameras_of, find_balls, most_pixels, of_cameras, place_windows
from mmpi_ns.scene.plan import NO_PLAN, ScenePlan
from mmpi_ns.scene.windows import Window, WindowedPlan, window_shares
from mmpi_ns.settings import PlacementConfig, ScheduleConfig
from mmpi_ns.training.phases import make_schedule
from mmpi_ns.utils.errors import InputError

# Splitting -----------------------------------------------------------------------------------------------------------


def road(length: float, spacing: float = 1.0) -> Observations:
    """Cameras that drive along a slow bend and see walls 6 away on both sides, some way ahead."""
    s = np.arange(0, length, spacing)
    centers = np.stack([s, 0 * s, 8 * np.sin(s / 60)], -1)
    heading = np.stack([np.ones_like(s), 0 * s, 8 / 60 * np.cos(s / 60)], -1)
    facing = heading / np.linalg.norm(heading, axis=-1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0])
    right = np.cross(facing, up)
    poses = np.stack([right, np.broadcast_to(up, right.shape), -facing, centers], -1)
    rng = np.random.default_rng(0)
    ahead, side = rng.uniform(4, 20, (len(s), 30)), rng.choice([-6.0, 6.0], (len(s), 30))
    points = centers[:, None] + ahead[..., None] * facing[:, None] + side[..., None] * right[:, None]
    points = points + rng.uniform(-2, 2, (len(s), 30))[..., None] * up
    return observed(poses, [100, 100, 80, 40], [160, 80], points, np.repeat(np.arange(len(s)), 30))


def test_a_short_capture_is_one_window_and_its_plan_is_written_as_before():
    plan = place_windows(road(30), PlacementConfig(max_texels=1e5))
    assert len(plan) == 1 and plan.windows[0].radius == math.inf
    assert "windows" not in json.loads(plan.to_json())
    assert ScenePlan.from_json(plan.to_json()) == plan.plans[0]


def test_steps_follow_the_pixels_of_the_largest_window():
    few, many = road(30), road(400)
    assert most_pixels(few, []) == few.sizes.prod(-1).sum() == most_pixels(few, find_balls(few, 4.0))
    assert 0.05 < most_pixels(many, find_balls(many, 4.0)) / many.sizes.prod(-1).sum() < 0.5
    assert most_pixels(many, WindowedPlan.single(NO_PLAN).windows) == many.sizes.prod(-1).sum()
    steps = [steps_for(pixels) for pixels in (1e4, 0.75 * FEW, FEW, MANY, 2 * MANY, 1e12)]
    assert steps == [2500, 3000, 4000, 4000, 8000, 12000]
    asked = ((FEW, 0.3), (MANY, 4.0), (2 * FEW, 4.0), (FEW, 4.0), (1e4, 4.0))  # the last three reach two rays a pixel
    assert [steps_for(pixels, size) for pixels, size in asked] == [1200, 16000, 10200, 4000, 2500]


@pytest.mark.parametrize(
    ("processors", "rays"),
    [(0, 1024), (4, 1024), (8, 2048), (28, 4096), (132, 4096)],  # CPU, 3060, T4 ...
)
def test_a_larger_gpu_draws_more_rays_a_step_and_in_all_up_to_two_a_pixel(processors, rays):
    times = rays_times(processors)
    assert times * RAYS == rays
    for pixels, multiple in (
        (1.0, 1),
        (0.25 * FEW, 1),
        (0.6 * FEW, 1),
        (2 * FEW, 10200 / 4000),
        (MANY, 4),
        (2.5 * MANY, 4),
    ):
        expected = steps_for(pixels) * (multiple if times > 1 else 1)
        assert times * steps_for(pixels, times=times) == pytest.approx(expected, abs=times)
    whole, fewer = (make_schedule(ScheduleConfig(), 2000 // n) for n in (1, times))
    assert [abs(times * a - b) < times for a, b in zip(fewer.growth, whole.growth, strict=True)] == [True] * 4


def test_windows_hold_every_camera_are_no_longer_than_asked_and_grow_with_the_road():
    counts = []
    for length in (200, 400, 800):
        seen = road(length)
        balls = find_balls(seen, 4.0)
        distance = np.stack([np.linalg.norm(seen.centers - ball.center, axis=-1) for ball in balls], -1)
        radii = np.array([ball.radius for ball in balls])
        assert (distance <= radii + 1e-9).any(-1).all()
        median = np.median(np.linalg.norm(seen.points - seen.centers[seen.seen_by], axis=-1))
        assert radii.max() < 0.75 * 4.0 * median
        order = np.array([ball.center for ball in balls])[:, 0]
        assert (np.diff(order) > 0).all() or (np.diff(order) < 0).all()  # along the road
        counts.append(len(balls))
    assert counts[0] >= 3
    assert 1.6 * counts[0] <= counts[1] <= 2.4 * counts[0] and 1.6 * counts[1] <= counts[2] <= 2.4 * counts[1]


def test_windows_do_not_depend_on_the_order_of_the_cameras():
    seen = road(200)
    shuffled = of_cameras(seen, np.random.default_rng(3).permutation(len(seen.centers)))
    for a, b in zip(find_balls(seen, 4.0), find_balls(shuffled, 4.0), strict=True):
        np.testing.assert_allclose(a.center, b.center, atol=1e-9)
        np.testing.assert_allclose([a.radius, a.margin], [b.radius, b.margin], rtol=1e-2)


def test_some_cameras_observations_are_those_of_the_whole():
    seen = road(40)
    chosen = np.array([7, 3, 20])
    part = of_cameras(seen, chosen)
    assert len(part.centers) == 3 and len(part.seen_by) == 90
    for new, old in enumerate(chosen):
        np.testing.assert_array_equal(part.centers[new], seen.centers[old])
        np.testing.assert_array_equal(
            np.sort(part.seen_point[part.seen_by == new]), np.sort(seen.seen_point[seen.seen_by == old])
        )


def test_mpis_a_ray_can_meet_do_not_grow_with_the_road():
    """All of a ray's MPIs are those of its windows; twice the road has twice the windows."""
    config = PlacementConfig(max_texels=2e6, max_planes=32)
    short, long = (place_windows(road(length, 4.0), config) for length in (220, 440))
    most, total = ([f(len(p.mpis) for p in plan.plans) for plan in (short, long)] for f in (max, sum))
    assert len(long) >= 1.6 * len(short) >= 4
    assert 1.6 * total[0] <= total[1] <= 2.5 * total[0]
    assert most[1] <= 1.25 * most[0] + 1


# Shares --------------------------------------------------------------------------------------------------------------


def line_of(*places: float, radius=1.0, margin=0.5) -> tuple[Window, ...]:
    plan = ScenePlan((make_mpi(),), None, 0.05, 1.5)
    return tuple(Window((x, 0.0, 0.0), radius, margin, plan) for x in places)


def along(*x: float) -> torch.Tensor:
    return torch.tensor([[v, 0.0, 0.0] for v in x])


def test_shares_are_whole_inside_alone_and_even_in_the_middle_of_an_overlap():
    windows = line_of(0.0, 2.5)
    shares = window_shares(along(0.0, 0.5, 1.25, 2.5, 9.0, -7.0), windows)
    expected = [[1, 0], [1, 0], [0.5, 0.5], [0, 1], [0, 1], [1, 0]]
    torch.testing.assert_close(shares, torch.tensor(expected).float())


def test_shares_change_steadily_along_the_way():
    windows = line_of(0.0, 2.2, 4.0)
    shares = window_shares(along(*np.linspace(-1, 5, 6001).tolist()), windows)
    torch.testing.assert_close(shares.sum(-1), torch.ones(6001))
    assert shares.diff(dim=0).abs().max() < 0.001 / 0.5 * 1.01


@pytest.mark.parametrize("spacing", [8.0, 20.0, 60.0])
def test_shares_are_continuous_along_the_way_however_sparse_its_cameras(spacing):
    seen = road(60 * spacing, spacing)
    balls = find_balls(seen, 5.0)
    between = np.linspace(0, len(seen.centers) - 1, 60_001)
    way = np.stack([np.interp(between, np.arange(len(seen.centers)), x) for x in seen.centers.T], -1)
    assert len(balls) > 1
    assert window_shares(torch.from_numpy(way), tuple(balls)).diff(dim=0).abs().max() < 0.05


def test_a_window_without_cameras_is_refused_in_one_sentence():
    with pytest.raises(InputError, match="holds no training camera"):
        cameras_of(line_of(1e4)[0], road(30).centers)


# Plans ---------------------------------------------------------------------------------------------------------------


def test_a_windowed_plan_survives_json():
    plan = WindowedPlan(line_of(0.0, 2.5))
    assert WindowedPlan.from_json(plan.to_json()) == plan
    assert plan.names[0].startswith("window 0: ") and plan.plans[0].num_heads == 1


@pytest.mark.parametrize("radius", [1.0, None])
def test_the_only_window_of_a_list_holds_all_cameras(radius):
    """Of an edited plan, say: its ball, also null, means nothing."""
    data = json.loads(WindowedPlan(line_of(0.0, 2.5)).to_json())
    data["windows"] = [data["windows"][0] | {"radius": radius}]
    plan = WindowedPlan.from_json(json.dumps(data))
    assert len(cameras_of(plan.windows[0], road(30).centers)) == 30 and WindowedPlan.from_json(plan.to_json()) == plan


@pytest.mark.parametrize(
    "change, sentence",
    [
        (lambda d: d["windows"][1].pop("margin"), "Window 1 of the plan lacks \\['margin'\\]"),
        (lambda d: d["windows"][1].update(radius=None), "radius"),
        (lambda d: d["windows"][0].update(margin=0.0), "'margin' of window 0"),
        (lambda d: d.update(windows=[]), "at least one window"),
    ],
)
def test_a_windowed_plan_that_cannot_be_used_is_refused(change, sentence):
    data = json.loads(WindowedPlan(line_of(0.0, 2.5)).to_json())
    change(data)
    with pytest.raises(ValueError, match=sentence):
        WindowedPlan.from_json(json.dumps(data))


def test_a_schedule_walks_through_each_window_anew():
    one = schedule_of("two-phase", 20, blend_share=0.25, finetune_share=0.25)
    three = replace(one, windows=3)
    assert three.total_steps == 60
    for step in range(60):
        window, local = divmod(step, 20)
        assert three.window_at(step) == window
        assert three.phase_at(step).name == one.phase_at(local).name
        assert three.phase_at(step).start <= step < three.phase_at(step).end
        assert three.texel_factor(step) == one.texel_factor(local)
        assert three.sharpened(step) == one.sharpened(local)
        assert three.rate_factor("density", step) == pytest.approx(one.rate_factor("density", local))
    assert three.window_at(60) == 2


# Long captures in little memory --------------------------------------------------------------------------------------


def test_a_capture_too_large_for_memory_is_read_window_by_window_with_the_same_draws(scene):
    cameras = np.array([1, 2, 5])
    at_once, by_window = (datamanager(scene, resident_pixels=limit) for limit in (60e6, 0))
    assert at_once.sources is not None and by_window.sources is None
    for manager in (at_once, by_window):
        manager.use_cameras(cameras)
        manager.train()
    ours, theirs = by_window.sources.pixels, at_once.sources.pixels
    assert ours.images.tolist() == theirs.images.tolist() == [1, 2, 5] and len(ours.colors) < len(theirs.colors)
    for step in range(3):
        (ours, a), (theirs, b) = (m.next_train(step) for m in (at_once, by_window))
        assert torch.equal(a["image"], b["image"]) and torch.equal(a["indices"], b["indices"])
        assert torch.equal(ours.directions, theirs.directions)
        assert set(a["indices"][:, 0].tolist()) <= {1, 2, 5}
