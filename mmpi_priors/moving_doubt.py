"""Whether a drive may show cars that keep their distance without their being masked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mmpi_priors.moving_evidence import SLOPE, Mask, Shot
from mmpi_priors.moving_sweep import is_straight
from mmpi_priors.views import pixel_grid

ENOUGH = 100
"""Pixels of known depth below the horizon from which a shot tells how far the road is below the camera."""
ALIKE, ROAD, DEEP = 0.2, 0.3, 1.0
"""Logarithms of that height that agree, share of what shots tell that must agree on the road, and logarithm from which
on something lies deep below it."""
SUNK = 0.1
"""Share that lies deep below the road from which masks are doubtful. Captures that are masked well have 0 to 0.04, a
motorway with two cars ahead 0.28."""
GROUNDS, AHEAD, MANY = 0.25, 0.8, 8
"""Share of the shots in which a ground is found: a drive of fewer is doubtful. Cosine between the directions of a drive
and its steps, half of them at least. Of fewer shots than the last nothing is said."""
LONG, STEADY = 8.0, 0.9999
"""A drive's path is at least so many times as long as its camera is above the road (a drone is far above what it flies
over); a car turns its camera so little from image to image, as a cosine, half of the times at least (a hand turns it
by degrees from step to step)."""


def doubt_of(shots: Sequence[Shot], up: NDArray[np.float64], masks: Sequence[Mask]) -> str:
    """A sentence that says why masks of a drive are doubtful; empty if they are not, or if nothing shows that this is a
    drive: a camera that looks along its path, turns as little as a car, and is close above a road if it shows one.

    Args:
        shots: of the capture.
        up: unit vector in the world. [3]
        masks: what is masked. [h, w] each
    """
    if len(shots) < MANY:
        return ""
    views, grounds = [shot.view for shot in shots], sum(shot.ground is not None for shot in shots)
    centers, facing = (np.stack([view.pose[:, column] for view in views]) for column in (3, 2))
    steps, turns = np.diff(centers, axis=0), (facing[1:] * facing[:-1]).sum(-1)
    lengths = np.linalg.norm(steps, axis=-1)
    ahead = np.abs((facing[1:] * steps).sum(-1)) / np.maximum(lengths, 1e-12)
    if np.median(ahead) <= AHEAD or np.median(turns) < STEADY:
        return ""
    ends = " Cars that keep their distance may not be masked and become streaks: mask them by hand (mask_path)."
    sunk, height = share_sunk(shots, up, masks)
    if sunk >= SUNK and lengths.sum() >= LONG * height:
        return (
            f"This looks like a drive along a road. What moves is doubtful: {sunk:.0%} of what lies below the horizon "
            "seems to be far below the road, as cars do that go as fast as the camera, and its own bonnet." + ends
        )
    if is_straight(views) and grounds < GROUNDS * len(shots):
        return (
            "This looks like a drive straight ahead. What moves is doubtful: the road is found in "
            f"{grounds} of {len(shots)} images." + ends
        )
    return ""


def share_sunk(shots: Sequence[Shot], up: NDArray[np.float64], masks: Sequence[Mask]) -> tuple[float, float]:
    """Share of what is measured below the horizon, in all shots, that seems to lie deep below the road, and how far the
    road, which is as far below all cameras of a drive, is below them; 0 where none stands out. Arguments are those of
    ``doubt_of``."""
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
