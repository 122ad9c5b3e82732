"""Somebody who walks ahead is followed to images that show nothing of it by themselves; what stands is not."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from mmpi_priors.dense import Depth
from mmpi_priors.moving_evidence import Shot
from mmpi_priors.moving_follow import upright_objects
from mmpi_priors.views import View

SIZE, FOCAL, HEIGHT, STEP = (120, 200), 200.0, 1.5, 1.0
"""Rows and columns, pixels, metres of the cameras over the ground and between them."""


def texture(seed: int, shape: tuple[int, int], grain: float) -> np.ndarray:
    random = np.random.default_rng(seed).uniform(-1, 1, (*shape, 3)).astype(np.float32)
    blurred = cv2.GaussianBlur(random, (0, 0), grain)
    return (128 + 60 / blurred.std() * blurred).clip(0, 255).astype(np.uint8)


def a_shot(turn: float, step: float, person: tuple[float, float]) -> tuple[Shot, np.ndarray]:
    """A camera that stands so many metres ahead, with a picture of a person at metres right and ahead of the start, and
    where it shows that."""
    c, s = np.cos(turn), np.sin(turn)
    ahead = person[1] - step
    right, depth = c * person[0] - s * ahead, s * person[0] + c * ahead
    column, foot = 100 + FOCAL * right / depth, 40 + FOCAL * HEIGHT / depth
    tall, wide = 1.7 * FOCAL / depth, 0.5 * FOCAL / depth
    x, y = np.meshgrid(np.arange(SIZE[1]) + 0.5, np.arange(SIZE[0]) + 0.5)
    u, v = (x - column) / wide + 0.5, (y - foot) / tall + 1
    visible = (u > 0) & (u < 1) & (v > 0) & (v < 1)
    color = texture(7, SIZE, 2.0)
    picture = cv2.remap(
        texture(1, (90, 30), 3.0), (30 * u - 0.5).astype(np.float32), (90 * v - 0.5).astype(np.float32),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    color[visible] = picture[visible]
    pose = np.array([[c, 0, -s, 0], [0, 1, 0, 0], [s, 0, c, -step]], float)
    view = View(
        cv2.cvtColor(color, cv2.COLOR_BGR2GRAY), np.array([FOCAL, FOCAL, 100.0, 40.0]), pose, np.ones(SIZE, bool)
    )
    ground = np.maximum((y - 40) / FOCAL / HEIGHT, 0).astype(np.float32)
    return Shot(view, color, Depth(ground, 0.01 * ground), ground), visible


def seen(places, masked):
    """What is followed to three images from those that are masked, and the truth."""
    # Turned by 28 pixels between two.
    pairs = [a_shot(0.14 * k, k * STEP, place) for k, place in enumerate(places)]
    truth = [visible for _, visible in pairs]
    masks = [t if k in masked else np.zeros(SIZE, bool) for k, t in enumerate(truth)]
    with ThreadPoolExecutor(1) as pool:
        parts = upright_objects([shot for shot, _ in pairs], [[1, 2], [0, 2], [1, 0]], masks, pool)
    return parts, truth


@pytest.mark.parametrize("hidden", [0, 1])
def test_somebody_ahead_is_followed_to_an_image_that_is_turned(hidden):
    parts, truth = seen([(0.3, 6.0), (0.3, 7.0), (0.3, 8.0)], {0, 1, 2} - {hidden})
    around = cv2.dilate(truth[hidden].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0  # a pixel at half the size
    assert parts[hidden][truth[hidden]].mean() > 0.65 and not parts[hidden][~around].any()


def test_somebody_who_stands_is_not_followed():
    parts, _ = seen([(0.3, 8.0)] * 3, {0, 1})
    assert not any(part.any() for part in parts)
