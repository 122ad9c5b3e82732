"""A hand-held walk down a street: a phone's lens, steps, a shaking hand, slow turns from side to side."""

from __future__ import annotations

import numpy as np

from mmpi_ns.synthetic.cameras import Array, Cameras
from mmpi_ns.synthetic.kit import look
from mmpi_ns.synthetic.road import Road
from mmpi_ns.synthetic.scene import Scene
from mmpi_ns.synthetic.street import make_street

EYE = 1.6
"""Metres from the ground to the phone."""
PACE, STEPS = 1.3, 1.9
"""Metres and steps a second."""
FOCAL_SHARE = 0.76
"""Focal length as a share of the image width, as of a phone's video."""
LENS = (-0.11, 0.045, 0.0012, -0.0008)
"""k1, k2, p1, p2: pixels at the corners of a wide image are 4 % nearer to its middle than in a pinhole."""
ASIDE, WEAVE = -2.2, 0.8
"""Metres to the left of the middle line, and by how much that changes: the right side of the carriageway."""
TURN, GLANCE, NOD = 0.7, 0.2, 0.05
"""Radians: slow turns towards the house fronts, faster and smaller ones, and up and down."""
SHAKE = (0.009, 0.008, 0.012)
"""Standard deviation of yaw, pitch and roll by a shaking hand, radians."""
SLOWEST, FASTEST = 0.7, 6.0
"""Shakes a second."""
STRIDE = (0.03, 0.025)
"""Metres of sway from step to step, and of bob with each."""


def walk(seed: int, count: int, width: int, height: int, length: float) -> Scene:
    """A walk down a gently bending street, with a lens; exact poses and depths."""
    random = np.random.default_rng([seed, 17])
    road = Road(length, ((5.0, 170.0, float(random.uniform(0, 2 * np.pi))),), beyond=150.0)
    along = np.linspace(0, length, count) if count > 1 else np.zeros(1)
    seconds = along / PACE
    phases = random.uniform(0, 2 * np.pi, 6)

    def wave(k: int, size: float, turns: Array) -> Array:
        return size * np.sin(2 * np.pi * turns + phases[k])

    sway, bob = wave(0, STRIDE[0], seconds * STEPS / 2), wave(1, STRIDE[1], seconds * STEPS)
    xy, heading = road.at(along, ASIDE + wave(2, WEAVE, along / 35) + sway)
    yaw_shake, pitch_shake, roll = (_shake(random, seconds, size) for size in SHAKE)
    yaw = heading + wave(3, TURN, along / 27) + wave(4, GLANCE, along / 10) + yaw_shake
    poses = look(np.column_stack([xy, EYE + bob]), yaw, wave(5, NOD, along / 14) + pitch_shake)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    right, up = poses[:, :, 0], poses[:, :, 1]
    poses[:, :, 0], poses[:, :, 1] = c * right + s * up, c * up - s * right
    cameras = Cameras(poses, FOCAL_SHARE * width, width, height, test_every=8, distortion=LENS)
    return make_street("walk", road, seed, cameras)


def _shake(random: np.random.Generator, seconds: Array, size: float) -> Array:
    """Band-limited noise [M] of standard deviation ``size`` at times [M]: equal waves at random frequencies."""
    frequencies = np.exp(random.uniform(np.log(SLOWEST), np.log(FASTEST), 12))
    turns = seconds[:, None] * frequencies + random.uniform(0, 1, 12)
    return size * np.sqrt(2 / 12) * np.sin(2 * np.pi * turns).sum(-1)
