"""Distance of matches from their epipolar lines: a test of poses that needs no triangulated points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def sampson(first: Array, second: Array, essential: Array) -> Array:
    """Distance of matches from their epipolar lines, to first order, in units of the rays' plane z = 1. [M]

    Args:
        first, second: rays of the matches with z = 1. [M, 3]
        essential: second from first. [3, 3]

    Source: Hartley and Zisserman, Multiple View Geometry, eq. 11.9.
    """
    there, back = first @ essential.T, second @ essential
    gradient = (there[:, :2] ** 2).sum(-1) + (back[:, :2] ** 2).sum(-1)
    return np.abs((second * there).sum(-1)) / np.sqrt(np.maximum(gradient, 1e-24))
