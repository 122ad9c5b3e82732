"""Nearest views that face the same way, whose images can be compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

APART = 1e-9
"""Cameras closer together than this fraction of the largest distance (at least 1) stand in one place: no parallax."""


def nearest_views(
    camera_to_worlds: NDArray[np.float64],
    i: int,
    count: int,
    max_angle: float = 180.0,
    among: Sequence[int] | NDArray[np.int64] | None = None,
    apart: bool = True,
) -> list[int]:
    """Cameras nearest to camera ``i`` with a similar viewing direction, nearest first.

    Args:
        camera_to_worlds: poses, axes in columns, z backwards or forwards. [M, 3, 4]
        max_angle: between viewing directions, degrees.
        among: the cameras to choose from; None for all.
        apart: only cameras in another place, whose images have a parallax.
    """
    others = np.arange(len(camera_to_worlds)) if among is None else np.asarray(among, np.int64)
    distance = np.linalg.norm(camera_to_worlds[others, :, 3] - camera_to_worlds[i, :, 3], axis=-1)
    usable = distance > APART * max(1.0, float(distance.max(initial=0.0))) if apart else others != i
    if max_angle < 180:
        usable &= camera_to_worlds[others, :, 2] @ camera_to_worlds[i, :, 2] > np.cos(np.radians(max_angle))
    order = np.argsort(np.where(usable, distance, np.inf), kind="stable")
    return others[order[: min(count, int(usable.sum()))]].tolist()
