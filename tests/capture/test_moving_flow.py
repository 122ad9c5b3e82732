"""What keeps its distance to the camera lies below the ground, and what hangs in the air comes towards it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mmpi_ns.capture.dense import Depth
from mmpi_ns.capture.moving_evidence import Shot
from mmpi_ns.capture.moving_flow import floats, moves_apart
from mmpi_ns.capture.views import View

SIZE, FOCAL, HEIGHT = (120, 160), 140.0, 1.5
PINHOLE = np.array([FOCAL, FOCAL, 80.0, 60.0])


def ground() -> np.ndarray:
    """Inverse depth of a plane below the camera. [h, w]"""
    rows = np.arange(SIZE[0])[:, None] + 0.5
    return np.repeat(np.maximum((rows - 60) / FOCAL / HEIGHT, 0), SIZE[1], 1).astype(np.float32)


def a_shot(ahead: float, gray=None, inverse=None, aside: float = 0.0) -> Shot:
    """Of a camera that stands so far ahead, above the ground."""
    pose = np.eye(4)[:3]
    pose[0, 3], pose[2, 3] = aside, -ahead
    gray = np.zeros(SIZE, np.uint8) if gray is None else gray
    inverse = ground() if inverse is None else inverse
    view = View(gray, PINHOLE, pose, np.ones(SIZE, bool))
    return Shot(view, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), Depth(inverse, 0.01 * inverse), ground())


def with_box(over_ground: float) -> np.ndarray:
    """The ground, and before it a box whose inverse depth is that of the ground at its foot times a factor."""
    inverse = ground()
    inverse[50:80, 60:90] = over_ground * inverse[80, 0]
    return inverse


@pytest.mark.parametrize(("over_ground", "share"), [(2.0, 0.8), (1.1, 0.0)])
def test_a_box_in_the_air_floats_and_one_on_the_ground_does_not(over_ground, share):
    shots = [a_shot(ahead, inverse=with_box(over_ground)) for ahead in (0.0, 1.0, 2.0)]
    seen = floats(shots[0], shots[1:])
    assert seen[50:80, 60:90].mean() >= share
    outside = seen.copy()
    outside[50:80, 60:90] = False
    assert not outside.any() and (share or not seen.any())


def test_nothing_floats_for_cameras_that_turn_aside():
    shots = [a_shot(a, inverse=with_box(2.0), aside=s) for a, s in ((0.0, 0.0), (1.0, 0.0), (2.0, 0.5))]
    assert not floats(shots[0], shots[1:]).any()


def street(ahead: float, texture: np.ndarray) -> np.ndarray:
    """A textured ground as a camera sees it that stands so far ahead."""
    columns = np.arange(SIZE[1], dtype=np.float32) + 0.5
    depth = 1 / np.maximum(ground(), 1e-3)
    right, forward = (columns - 80) / FOCAL * depth, depth + ahead
    return cv2.remap(texture, 30 * right + 400, 30 * forward, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def test_a_car_that_keeps_its_distance_lies_below_the_ground_and_the_street_does_not():
    random = np.random.default_rng(0)
    texture = cv2.GaussianBlur(random.uniform(-1, 1, (800, 800)).astype(np.float32), (0, 0), 4.0)
    texture = (128 + 700 * texture).clip(0, 255).astype(np.uint8)
    car = cv2.GaussianBlur(random.uniform(-1, 1, (30, 40)).astype(np.float32), (0, 0), 2.0)
    grays = [street(1.0 * k, texture) for k in range(3)]
    shots = []
    for k, gray in enumerate(grays):
        gray[75:105, 60:100] = (128 + 500 * car).clip(0, 255)
        shots.append(a_shot(1.0 * k, np.ascontiguousarray(gray)))
    truth = np.zeros(SIZE, bool)
    truth[75:105, 60:100] = True
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    seen = moves_apart(shots[0], shots[1:], flow)
    assert seen[truth].mean() > 0.3 and seen[~truth].mean() < 0.01
    assert not moves_apart(replace(shots[0], ground=None), shots[1:], flow).any()
