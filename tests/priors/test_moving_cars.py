"""Cars on a drive: what keeps its distance or overtakes has a depth that nothing static has, what comes towards hangs
in the air. A car is followed along the path, one that leaves the image too; what stands is not, nor what one image
takes for a mover by mistake."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mmpi_priors.dense import Depth
from mmpi_priors.moving_carry import carried
from mmpi_priors.moving_evidence import Neighbour, Shot
from mmpi_priors.moving_sweep import floats, sweep
from mmpi_priors.views import View

SIZE, FOCAL, HEIGHT = (160, 240), 200.0, 1.5
PINHOLE = np.array([FOCAL, FOCAL, 120.0, 60.0])
STEP = 1.4
"""Metres between images."""


def texture(seed: int, shape: tuple[int, int], gain: float) -> np.ndarray:
    random = np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)
    return (128 + gain * cv2.GaussianBlur(random, (0, 0), 4.0)).clip(0, 255).astype(np.uint8)


def ground() -> np.ndarray:
    """Inverse depth of a plane below the camera. [h, w]"""
    rows = np.arange(SIZE[0])[:, None] + 0.5
    return np.repeat(np.maximum((rows - 60) / FOCAL / HEIGHT, 0), SIZE[1], 1).astype(np.float32)


def an_image(ahead: float, *boxes: tuple[float, float], knows: bool = True) -> tuple[Shot, list[np.ndarray]]:
    """A camera so far ahead on a textured ground with boxes, so far aside and from the start; where it shows them.
    Unless it ``knows`` them its depths are those of the ground."""
    across, along = np.meshgrid(np.arange(SIZE[1]) + 0.5, np.arange(SIZE[0]) + 0.5)
    depth, inverse, visible = 1 / np.maximum(ground(), 1e-3), np.maximum(ground(), 0.05), []
    places = (p.astype(np.float32) for p in (30 * (across - 120) / FOCAL * depth + 400, 30 * (depth + ahead)))
    gray = cv2.remap(texture(0, (900, 800), 700), *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    for seed, (aside, at) in reversed([*enumerate(boxes, 1)]):
        far = at - ahead
        right, down = (across - 120) / FOCAL * far - aside, (along - 60) / FOCAL * far - HEIGHT
        box = (right > 0) & (right < 1.6) & (down < 0) & (down > -1.4)
        places = ((p * 50 + 100).astype(np.float32) for p in (right, down))
        painted = cv2.remap(texture(seed, (200, 200), 900), *places, cv2.INTER_LINEAR)
        gray[box], inverse[box & knows] = painted[box], 1 / far
        visible.insert(0, box)
    pose = np.eye(4)[:3]
    pose[2, 3] = -ahead
    view = View(gray, PINHOLE, pose, np.ones(SIZE, bool))
    return Shot(view, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), Depth(inverse, 0.01 * inverse), ground()), visible


# What moves in one image and its neighbours --------------------------------------------------------------------------


def shots_of(speed: float) -> tuple[Shot, list[Neighbour], np.ndarray]:
    """Five images on a straight line, and the truth of the one in the middle. The box in the lane moves so fast, as a
    multiple of the camera's speed; another one stands beside it."""
    images = [an_image(k * STEP, (-0.8, 6 + speed * k * STEP), (2.2, 7.0), knows=False) for k in (0, -1, 1, -2, 2)]
    (shot, (truth, _)), *others = images
    return shot, [Neighbour.of(shot, other) for other, _ in others], truth


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


# What is followed ----------------------------------------------------------------------------------------------------


def a_path(speed: float) -> tuple[Shot, list[Neighbour], list[np.ndarray], list[list[np.ndarray]]]:
    """The last image of a path, those before it, where it shows a box that moves so fast (in speeds of the camera) and
    one that stands, and where they do. The box that moves is about to leave at the side."""
    images = [an_image(-k * STEP, (-2.1, 3.4 - speed * k * STEP), (1.0, 6.0)) for k in range(5)]
    (shot, visible), *before = images
    return shot, [Neighbour.of(shot, other) for other, _ in before], visible, [boxes for _, boxes in before]


@pytest.mark.parametrize("speed", [-0.8, 1.0, 1.3])
def test_a_car_that_leaves_the_image_is_followed_to_it(speed):
    """It comes towards the camera, keeps its distance, or overtakes."""
    shot, others, (car, standing), masks = a_path(speed)
    inner = carried(shot, others, [boxes[0] for boxes in masks], np.zeros(SIZE, bool)).pixels
    around = cv2.dilate(car.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert car[:, 0].any(), "the test's car does not leave"
    assert inner[car].mean() > 0.2 and not inner[~around].any() and not inner[standing].any()


def test_what_one_image_takes_for_a_mover_by_mistake_is_not_followed():
    shot, others, (_, standing), masks = a_path(1.0)
    nothing = np.zeros(SIZE, bool)
    carry = carried(shot, others, [masks[0][1], *[nothing] * 3], nothing)
    assert not (carry.pixels | carry.objects)[standing].any()


def test_nothing_is_followed_where_nothing_moves_or_there_is_no_ground():
    shot, others, _, masks = a_path(1.0)
    nothing = np.zeros(SIZE, bool)
    for carry in (
        carried(shot, others, [nothing] * 4, nothing),
        carried(replace(shot, ground=None), others, [boxes[0] for boxes in masks], nothing),
    ):
        assert not carry.pixels.any() and not carry.objects.any()
