"""Outlines of what moves, once it is roughly known in all images.

Objects grow along edges of an image, so they reach on to what stands beside them and of which neighbours show nothing
new: between two cars, on the road around them, on a parked car behind. But without what moves in the neighbours, a
static scene explains all that stands, at a depth that it may have, and little of what moves: so what it explains leaves
a mask from outside, and what it does not, next to a mask, joins it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mmpi_priors.moving_evidence import ALL, Bytes, Mask, Neighbour, Shot, least_unlike
from mmpi_priors.moving_objects import filled, touching

EXPLAINED, UNLIKE = 1.0, 8.0
"""Levels beyond the image's noise up to which one neighbour explains a pixel, and from which none does."""
OVER, LEVEL = 8, 3
"""Pixels above the highest seed of a column and below the horizon from which on nothing leaves a mask: roofs and heads
of what is as high as the camera stand before what hardly shifts from image to image."""
CLOSED, OPENED, AROUND = 5, 3, 9
"""Pixels across which what is left is closed and what joins is opened, and around a mask in which it may lie."""
REACH = AROUND + 8
"""Pixels around all masks of an image in which it is compared: what joins, a pixel of margin, and windows."""


def outlined(
    shot: Shot, others: Sequence[Neighbour], masks: Sequence[Mask], mask: Mask, core: Mask, noise: float
) -> Mask:
    """A mask without what a static scene explains around its seeds, and with what it does not explain next to it.

    Args:
        shot: the image.
        others: its neighbours.
        masks: what moves in each. [h, w]
        mask: what moves in the shot. [h, w]
        core: seeds, which stay; so do objects without any. [h, w]
        noise: levels by which surfaces differ from what explains them.
    """
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    box = np.s_[max(y - REACH, 0) : y + height + REACH, max(x - REACH, 0) : x + width + REACH]
    unlike, core = least_unlike(shot, others, masks, box), core | (mask & ~touching(mask, core))
    rows = np.arange(len(mask))[:, None]
    last = len(mask) - 1 - core[::-1].argmax(0)
    body = core | (core.any(0) & (rows >= core.argmax(0) - OVER) & (rows <= last))
    leaves = mask & (unlike < noise + EXPLAINED) & ~body
    if shot.level is not None:
        leaves &= rows > shot.level + LEVEL
    padded = np.pad((mask & ~leaves).astype(np.uint8), CLOSED)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(CLOSED))[CLOSED:-CLOSED, CLOSED:-CLOSED] > 0
    left = touching(closed & mask, core)
    near = cv2.dilate(left.astype(np.uint8), _disc(2 * AROUND + 1)) > 0
    joins = near & (unlike > noise + UNLIKE) & (unlike < ALL)
    both = cv2.morphologyEx((left | joins).astype(np.uint8), cv2.MORPH_OPEN, _disc(OPENED)) > 0
    shown = filled(touching(both | left, left))
    # Pixels along an outline mix what is on both sides of it.
    return shown | ((cv2.dilate(shown.astype(np.uint8), _disc(3)) > 0) & (unlike >= noise + EXPLAINED))


def _disc(across: int) -> Bytes:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (across, across)), np.uint8)
