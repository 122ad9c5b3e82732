"""A car is followed along the path, one that leaves the image too; what stands is not, nor what one image takes for a
mover by mistake."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mmpi_priors.dense import Depth
from mmpi_priors.moving_carry import carried
from mmpi_priors.moving_evidence import Neighbour, Shot
from mmpi_priors.views import View

SIZE, FOCAL, HEIGHT = (160, 240), 200.0, 1.5
PINHOLE = np.array([FOCAL, FOCAL, 120.0, 60.0])
STEP = 1.4
"""Metres between images."""


def texture(seed: int, shape: tuple[int, int]) -> np.ndarray:
    random = np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)
    return (128 + 800 * cv2.GaussianBlur(random, (0, 0), 4.0)).clip(0, 255).astype(np.uint8)


def ground() -> np.ndarray:
    """Inverse depth of a plane below the camera. [h, w]"""
    rows = np.arange(SIZE[0])[:, None] + 0.5
    return np.repeat(np.maximum((rows - 60) / FOCAL / HEIGHT, 0), SIZE[1], 1).astype(np.float32)


def an_image(ahead: float, boxes: list[tuple[float, float]]) -> tuple[Shot, list[np.ndarray]]:
    """A camera so far ahead on a textured ground with boxes, so far aside and from the start; where it shows them."""
    across, along = np.meshgrid(np.arange(SIZE[1]) + 0.5, np.arange(SIZE[0]) + 0.5)
    inverse, shown = np.maximum(ground(), 0.05), []
    places = 30 * (across - 120) / FOCAL / inverse + 400, 30 * (1 / inverse + ahead)
    gray = cv2.remap(
        texture(0, (900, 800)), *(p.astype(np.float32) for p in places), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    for seed, (aside, at) in enumerate(boxes, 1):
        far = at - ahead
        right, down = (across - 120) / FOCAL * far - aside, (along - 60) / FOCAL * far - HEIGHT
        box = (right > 0) & (right < 1.6) & (down < 0) & (down > -1.4)
        painted = cv2.remap(texture(seed, (200, 200)), *((p * 50 + 100).astype(np.float32) for p in (right, down)), 1)
        gray[box], inverse[box] = painted[box], 1 / far
        shown.append(box)
    pose = np.eye(4)[:3]
    pose[2, 3] = -ahead
    view = View(gray, PINHOLE, pose, np.ones(SIZE, bool))
    inverse = inverse.astype(np.float32)
    return Shot(view, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), Depth(inverse, 0.01 * inverse), ground()), shown


def a_path(speed: float) -> tuple[Shot, list[Neighbour], list[np.ndarray], list[list[np.ndarray]]]:
    """The last image of a path, those before it, where it shows a box that moves so fast (in speeds of the camera) and
    one that stands, and where they do. The box that moves is about to leave at the side."""
    images = [an_image(-k * STEP, [(-2.1, 3.4 - speed * k * STEP), (1.0, 6.0)]) for k in range(5)]
    (shot, shown), *before = images
    return shot, [Neighbour.of(shot, other) for other, _ in before], shown, [boxes for _, boxes in before]


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
