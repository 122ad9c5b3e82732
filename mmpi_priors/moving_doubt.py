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
"""Share of the shots in which a ground is found, and cosine between their directions and the path: a drive of fewer
grounds is doubtful. Of so few shots nothing is said."""


def doubt_of(shots: Sequence[Shot], up: NDArray[np.float64], masks: Sequence[Mask]) -> str:
    """A sentence that says why masks of a drive are doubtful; empty if they are not.

    Args:
        shots: of the capture.
        up: unit vector in the world. [3]
        masks: what is masked. [h, w] each
    """
    ends = " Cars that keep their distance may not be masked and become streaks: mask them by hand (mask_path)."
    if len(shots) < MANY:
        return ""
    if (sunk := share_sunk(shots, up, masks)) >= SUNK:
        return (
            f"What moves is doubtful: {sunk:.0%} of what lies below the horizon seems to be far below the road, as "
            "cars do that go as fast as the camera, and its own bonnet." + ends
        )
    views, grounds = [shot.view for shot in shots], sum(shot.ground is not None for shot in shots)
    centers, facing = (np.stack([view.pose[:, column] for view in views]) for column in (3, 2))
    along = np.linalg.svd(centers - centers.mean(0))[2][0]
    if is_straight(views) and np.median(np.abs(facing @ along)) > AHEAD and grounds < GROUNDS * len(shots):
        return f"What moves is doubtful: the road is found in {grounds} of {len(shots)} images." + ends
    return ""


def share_sunk(shots: Sequence[Shot], up: NDArray[np.float64], masks: Sequence[Mask]) -> float:
    """Share of what is measured below the horizon, in all shots, that seems to lie deep below the road; 0 where no road
    stands out. The road is as far below all cameras of a drive. Arguments are those of ``doubt_of``."""
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
        return 0.0
    alike = np.searchsorted(logs, logs + ALIKE) - np.searchsorted(logs, logs - ALIKE)
    return float((logs > logs[alike.argmax()] + DEEP).mean()) if alike.max() >= ROAD * len(logs) else 0.0
