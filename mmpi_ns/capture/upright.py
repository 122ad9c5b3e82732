"""Upwards in the world, as far as cameras tell of it. Needs no torch, which takes seconds to import."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

SLOPE = 0.3
"""Sine of the pitch up to which cameras may all be tilted on a level path."""
LEVEL_TURNS = (0.15, 0.1), (0.05, 0.01)
"""Cameras turn and are held level if their right vectors spread so far across their main direction, at least, and by
this share of it across the third one, at most (mean squares): a hand rolls a camera by a degree or two."""


def level_up(rights: Float[ndarray, "M 3"], up: Float[ndarray, "3"]) -> Float[ndarray, "3"] | None:
    """Upwards in the world, perpendicular to the right vectors of cameras that turn; None where they hardly do.

    ``up`` is about upwards: all cameras may look up or down.
    """
    values, vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    turns = any(values[1] > turn and values[0] < share * values[1] for turn, share in LEVEL_TURNS)
    return level if turns and level @ up > 0.5 else None


def upright(camera_to_worlds: Float[ndarray, "M 3 4"]) -> Float[ndarray, "3"]:
    """Upwards in the world: by cameras that turn, else what they take for it; made perpendicular to their path, which
    is about level."""
    up, centers = camera_to_worlds[:, :, 1].mean(0), camera_to_worlds[:, :, 3]
    up /= max(float(np.linalg.norm(up)), 1e-12)
    level = level_up(camera_to_worlds[:, :, 0], up)
    up = up if level is None else level
    along = np.linalg.svd(centers - centers.mean(0))[2][0]
    slope = float(up @ along)
    up = up - slope * along if abs(slope) < SLOPE else up
    return up / max(float(np.linalg.norm(up)), 1e-12)
