"""Check whether a drive may contain cars at constant distance that are not masked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mmpi_priors.moving_evidence import SLOPE, Mask, Shot
from mmpi_priors.moving_sweep import is_straight
from mmpi_priors.views import pixel_grid

ENOUGH = 100
"""Minimum number of pixels with a depth below the horizon for a shot to measure the height of the camera above the
road."""
ALIKE, ROAD, DEEP = 0.2, 0.3, 1.0
"""Tolerance of the log height, minimum share of measurements that agree on the road, and log ratio from which a point
lies far below it."""
SUNK = 0.1
"""Share of points far below the road from which masks are doubtful. Captures with good masks have 0 to 0.04, a motorway
with two cars ahead 0.28."""
GROUNDS, AHEAD, MANY = 0.25, 0.8, 8
"""Minimum share of shots with a detected ground; minimum median cosine between viewing directions and steps of a drive;
minimum number of shots for a doubt."""
LONG, STEADY = 8.0, 0.9999
"""Minimum ratio of path length and camera height of a drive (a drone is higher); minimum median cosine of the rotation
between images (a hand-held camera turns by degrees at each step)."""


def doubt_of(shots: Sequence[Shot], up: NDArray[np.float64], masks: Sequence[Mask]) -> str:
    """Sentence on why masks of a drive are doubtful; empty if they are not, or if the capture is not a drive: a camera
    that looks along its path, turns as little as a car, and is close above a road if it sees one. ``up`` is a unit
    vector in the world."""
    if len(shots) < MANY:
        return ""
    views, grounds = [shot.view for shot in shots], sum(shot.ground is not None for shot in shots)
    centers, facing = (np.stack([view.pose[:, column] for view in views]) for column in (3, 2))
    steps, turns = np.diff(centers, axis=0), (facing[1:] * facing[:-1]).sum(-1)
    lengths = np.linalg.norm(steps, axis=-1)
    ahead = np.abs((facing[1:] * steps).sum(-1)) / np.maximum(lengths, 1e-12)
    if np.median(ahead) <= AHEAD or np.median(turns) < STEADY:
        return ""
    ends = " Cars at a constant distance may not be masked and leave streaks: mask them by hand (mask_path)."
    sunk, height = share_sunk(shots, up, masks)
    if sunk >= SUNK and lengths.sum() >= LONG * height:
        return (
            f"This looks like a drive along a road. The masks are doubtful: {sunk:.0%} of what lies below the horizon "
            "appears far below the road, as do cars that drive as fast as the camera, and its own bonnet." + ends
        )
    if is_straight(views) and grounds < GROUNDS * len(shots):
        return (
            "This looks like a drive straight ahead. The masks are doubtful: the road is detected in "
            f"{grounds} of {len(shots)} images." + ends
        )
    return ""


def share_sunk(shots: Sequence[Shot], up: NDArray[np.float64], masks: Sequence[Mask]) -> tuple[float, float]:
    """Share of the points below the horizon, in all shots, that lie far below the road, and the height of the cameras
    above the road, which is constant on a drive; 0 if none stands out. Arguments are those of ``doubt_of``."""
    heights = [np.zeros(0)]
    for shot, mask in zip(shots, masks, strict=True):
        x, y = pixel_grid(shot.view.gray.shape)
        fx, fy, cx, cy = shot.view.pinhole
        upward = np.array([1, -1, -1]) * (shot.view.pose[:, :3].T @ up)
        down = -np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1) @ upward
        low = (shot.depth.inverse > 0) & (down > SLOPE) & ~mask
        if np.count_nonzero(low) >= ENOUGH:  # each shot counts alike
            logs = np.log(down[low] / shot.depth.inverse[low])
            heights.append(np.quantile(logs, np.linspace(0, 1, ENOUGH)))
    logs = np.sort(np.concatenate(heights))
    if 2 * len(logs) < ENOUGH * len(shots):
        return 0.0, 0.0
    alike = np.searchsorted(logs, logs + ALIKE) - np.searchsorted(logs, logs - ALIKE)
    if alike.max() < ROAD * len(logs):
        return 0.0, 0.0
    road = logs[alike.argmax()]
    return float((logs > road + DEEP).mean()), float(np.exp(road))
