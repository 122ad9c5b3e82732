"""What keeps its distance or overtakes has a depth that nothing static has; what comes towards hangs in the air."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mmpi_priors.dense import Depth
from mmpi_priors.moving_evidence import Neighbour, Shot
from mmpi_priors.moving_sweep import floats, sweep
from mmpi_priors.views import View

SIZE, FOCAL, HEIGHT = (160, 240), 200.0, 1.5
PINHOLE = np.array([FOCAL, FOCAL, 120.0, 60.0])
STEP = 1.4
"""Metres between images."""


def texture(seed: int, shape: tuple[int, int], grain: float, gain: float) -> np.ndarray:
    random = np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)
    return (128 + gain * cv2.GaussianBlur(random, (0, 0), grain)).clip(0, 255).astype(np.uint8)


def ground() -> np.ndarray:
    """Inverse depth of a plane below the camera. [h, w]"""
    rows = np.arange(SIZE[0])[:, None] + 0.5
    return np.repeat(np.maximum((rows - 60) / FOCAL / HEIGHT, 0), SIZE[1], 1).astype(np.float32)


def a_street(ahead: float, car: float, standing: float) -> tuple[np.ndarray, np.ndarray]:
    """The image of a camera that stands so far ahead on a textured ground, with a box in the lane whose back is so far
    from the start and another one beside it, and where it shows the first. [h, w] each"""
    across, along = np.meshgrid(np.arange(SIZE[1]) + 0.5, np.arange(SIZE[0]) + 0.5)
    depth = 1 / np.maximum(ground(), 1e-3)
    places = (30 * (across - 120) / FOCAL * depth + 400, 30 * (depth + ahead))
    places = [p.astype(np.float32) for p in places]
    image = cv2.remap(texture(0, (900, 800), 4.0, 700), *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    shown = np.zeros(SIZE, bool)
    for seed, aside, at in ((2, 2.2, standing), (1, -0.8, car)):
        far = at - ahead
        right, down = (across - 120) / FOCAL * far - aside, (along - 60) / FOCAL * far - HEIGHT
        box = (right > 0) & (right < 1.6) & (down < 0) & (down > -1.4)
        places = [(p * 50 + 100).astype(np.float32) for p in (right, down)]
        painted = cv2.remap(texture(seed, (200, 200), 4.0, 900), *places, cv2.INTER_LINEAR)
        image[box] = painted[box]
        shown = box if seed == 1 else shown
    return image, shown


def shots_of(speed: float) -> tuple[Shot, list[Neighbour], np.ndarray]:
    """Five images on a straight line, and the truth of the one in the middle. The box in the lane moves so fast, as a
    multiple of the camera's speed."""
    shots, truth = [], np.zeros(SIZE, bool)
    for k in (0, -1, 1, -2, 2):
        gray, shown = a_street(k * STEP, 6 + speed * k * STEP, 7.0)
        truth = shown if k == 0 else truth
        pose = np.eye(4)[:3]
        pose[2, 3] = -k * STEP
        view = View(gray, PINHOLE, pose, np.ones(SIZE, bool))
        inverse = np.maximum(ground(), 0.05)
        shots.append(Shot(view, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), Depth(inverse, 0.01 * inverse), ground()))
    others = [Neighbour.of(shots[0], shot) for shot in shots[1:]]
    return shots[0], others, truth


@pytest.mark.parametrize("speed", [1.0, 1.4])
def test_a_car_that_keeps_its_distance_or_overtakes_has_an_impossible_depth(speed):
    shot, others, truth = shots_of(speed)
    seen = sweep(shot, others)
    around = cv2.dilate(truth.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    assert seen.impossible[truth].mean() > 0.4 and not seen.impossible[~around].any()
    assert seen.certain[truth].mean() > 0.18 and seen.certain[~truth].mean() < 0.002


def test_a_car_that_comes_towards_the_camera_hangs_in_the_air():
    shot, others, truth = shots_of(-0.8)
    seen = sweep(shot, others)
    assert seen.certain[truth].mean() > 0.8 and seen.certain[~truth].mean() < 0.01


def test_what_stands_is_not_seen_to_move():
    shot, others, _ = shots_of(0.0)
    seen = sweep(shot, others)
    assert not seen.impossible.any() and not seen.certain.any()


def test_nothing_is_said_without_a_ground_or_with_one_neighbour():
    shot, others, _ = shots_of(1.0)
    assert not sweep(replace(shot, ground=None), others).impossible.any()
    assert not sweep(shot, others[:1]).impossible.any()


@pytest.mark.parametrize(("over_ground", "share"), [(2.0, 0.8), (1.1, 0.0)])
def test_a_box_in_the_air_floats_and_one_on_the_ground_does_not(over_ground, share):
    inverse = ground()
    inverse[70:100, 60:90] = over_ground * inverse[100, 0]
    seen = floats(inverse, ground())
    assert seen[70:100, 60:90].mean() >= share
    seen[70:100, 60:90] = False
    assert not seen.any()
