"""Outlines of moving objects, from rough masks in all images.

Segments grow along image edges and include static surfaces beside an object: between two cars, on the road, on a parked
car behind. With the moving objects of the neighbours masked, static pixels match them at some possible depth and moving
ones hardly do. So matched pixels are removed from a mask, from outside, and unmatched ones next to a mask are added.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mmpi_priors.moving_evidence import ALL, Bytes, Mask, Neighbour, Shot, least_unlike
from mmpi_priors.moving_objects import filled, touching

EXPLAINED, UNLIKE = 1.0, 8.0
"""Gray levels above the image's noise up to which a pixel matches a neighbour, and from which it matches none."""
OVER, LEVEL = 8, 3
"""Distances above the highest seed of a column and below the horizon beyond which nothing leaves a mask, pixels: behind
roofs and heads at camera height the background hardly shifts between images."""
CLOSED, OPENED, AROUND = 5, 3, 9
"""Sizes of the closing of what remains and the opening of what joins, and distance from a mask at which pixels may
join, pixels."""
REACH = AROUND + 8
"""Margin around all masks of an image within which it is compared, pixels."""


def outlined(
    shot: Shot, others: Sequence[Neighbour], masks: Sequence[Mask], mask: Mask, core: Mask, noise: float
) -> Mask:
    """A mask without the pixels around its seeds that match the static scene, and with those next to it that do not.

    Args:
        masks: of moving objects in each neighbour, as ``mask`` in the shot. [h, w]
        core: seeds, which remain; so do objects without any. [h, w]
        noise: gray levels by which static surfaces differ from their matches.
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
    visible = filled(touching(both | left, left))
    # Pixels along an outline mix both sides.
    return visible | ((cv2.dilate(visible.astype(np.uint8), _disc(3)) > 0) & (unlike >= noise + EXPLAINED))


def _disc(across: int) -> Bytes:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (across, across)), np.uint8)
