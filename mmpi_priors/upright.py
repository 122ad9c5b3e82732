"""The up direction of a scene, estimated from its cameras. Does not import torch, which takes seconds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

SLOPE = 0.3
"""Sine of the common pitch that cameras on a level path may have."""
LEVEL_TURNS = (0.15, 0.1), (0.05, 0.01)
"""Cameras turn and are held level if their right vectors spread so far across their main direction, at least, and by
this share of it across the third one, at most (mean squares): a hand rolls a camera by a degree or two."""


def level_up(rights: Float[ndarray, "M 3"], ups: Float[ndarray, "M 3"]) -> tuple[Float[ndarray, "3"], bool]:
    """The up direction from the right and up vectors of cameras, which may all look up or down, and whether they turn
    and are held level. If so, it is perpendicular to the right vectors, else the mean of the up vectors."""
    up = ups.mean(0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    values, vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    turns = any(values[1] > turn and values[0] < share * values[1] for turn, share in LEVEL_TURNS)
    return (level, True) if turns and level @ up > 0.5 else (up, False)


def upright(camera_to_worlds: Float[ndarray, "M 3 4"]) -> Float[ndarray, "3"]:
    """The up direction: that of ``level_up``, and for cameras that do not turn, made perpendicular to their path, which
    is about level."""
    (up, _), centers = level_up(camera_to_worlds[:, :, 0], camera_to_worlds[:, :, 1]), camera_to_worlds[:, :, 3]
    along = np.linalg.svd(centers - centers.mean(0))[2][0]
    slope = float(up @ along)
    up = up - slope * along if abs(slope) < SLOPE else up
    return up / max(float(np.linalg.norm(up)), 1e-12)
