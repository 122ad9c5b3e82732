"""When masks of a drive are called doubtful: shots of a level road, rendered as depths alone."""

import numpy as np
import pytest

from mmpi_priors.dense import Depth
from mmpi_priors.moving_doubt import MANY, SUNK, doubt_of, share_sunk
from mmpi_priors.moving_evidence import Shot
from mmpi_priors.views import View

UP = np.array([0.0, 0.0, 1.0])
FACING = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""Right, up and back of a camera in the world that looks along the first axis."""
AHEAD, ASIDE = np.eye(3), np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
HEIGHT, SHAPE = 1.5, (40, 60)


def shots_of(count=MANY, sunken=0.0, heights=HEIGHT, turn=AHEAD, has_ground=True, known=1.0, seed=0, step=2.0):
    """A drive along the first axis; a share of the road's pixels, which are noisy, belongs to cars with the speed
    0.9 of the camera's, which seem ten times as far."""
    random, shots = np.random.default_rng(seed), []
    for i, height in enumerate(np.broadcast_to(heights, count)):
        rows, _ = np.mgrid[:40, :60] + 0.5
        down = (rows - 20) / 30
        inverse = np.where(down > 0, down / height, 0.02) * random.normal(1, 0.03, SHAPE)
        inverse[(random.random(SHAPE) < sunken) & (down > 0)] *= 0.1
        inverse[random.random(SHAPE) >= known] = 0
        pose = np.concatenate([FACING @ turn, [[step * i], [0], [height]]], 1)
        view = View(np.zeros(SHAPE, np.uint8), np.array([30.0, 30, 30, 20]), pose, np.ones(SHAPE, bool))
        depth = Depth(inverse.astype(np.float32), np.full(SHAPE, 0.01, np.float32))
        ground = np.maximum(down / height, 0).astype(np.float32) if has_ground else None
        shots.append(Shot(view, np.zeros((*SHAPE, 3), np.uint8), depth, ground))
    return shots


def sunk(shots, masks=None):
    return share_sunk(shots, UP, masks or [np.zeros(SHAPE, bool) for _ in shots])[0]


def doubt(shots, masks=None):
    return doubt_of(shots, UP, masks or [np.zeros(SHAPE, bool) for _ in shots])


@pytest.mark.parametrize("sunken", [0.0, 0.03, 0.2, 0.4])
def test_the_share_that_lies_below_the_road_is_told_and_doubted(sunken):
    shots = shots_of(sunken=sunken)
    assert sunk(shots) == pytest.approx(sunken, abs=0.02)
    assert bool(doubt(shots)) == (sunken > SUNK)
    assert sunken < SUNK or f"{sunk(shots):.0%} of what lies below" in doubt(shots)


def test_of_a_camera_that_is_no_car_nothing_is_said():
    assert not doubt(shots_of(sunken=0.4, turn=ASIDE)), "it looks aside"
    assert doubt(shots_of(sunken=0.4)) and not doubt(shots_of(sunken=0.4, heights=30.0)), "a drone far above a shore"
    for by_hand in (shots_of(known=0.0, has_ground=False), shots_of(sunken=0.4)):
        for i, shot in enumerate(by_hand):
            angle = np.radians(1.5 * (i % 2))
            yaw = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
            shot.view.pose[:, :3] = shot.view.pose[:, :3] @ yaw
        assert not doubt(by_hand), "a hand turns it"
