"""What moves along the camera's path, followed into images in which too few neighbours show what is behind it.

A car that leaves an image at the side, or has just entered it, is large there, moves across much of the image from one
to the next, and hides what no other image shows. But as it moves parallel to the path, it has one inverse depth in all
images, if a false one (``moving_sweep.py``). So what moves in a neighbour is searched at inverse depths from behind the
camera to beyond the nearest content, by correlation at half the size. It counts where it is clearly more alike than
anything that stands in any neighbour, at a depth that something static may have. Paint has no texture of its own, so
pixels that move are scattered over a car; one that is not masked yet is taken as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from mmpi_priors.dense import mean_and_contrast
from mmpi_priors.moving_evidence import Mask, Neighbour, Shot
from mmpi_priors.moving_sweep import ALIKE, CONTRAST, INSIDE, compared, solid
from mmpi_priors.ops.likeness import Likeness, most_alike
from mmpi_priors.views import Map

AFTER, STATIC = 2, 4
"""Nearest neighbours from which what moves is followed, and whose static content is compared."""
BEHIND, BEYOND, DEPTHS = -0.5, 2.0, 72
"""Inverse depths, from the first to the second multiple of the nearest content's: what comes towards the camera seems
nearer than it is."""
GROUND, MARGIN, REACH = 0.9, 0.02, 1.2
"""Static content has at least this multiple of the ground's inverse depth less this multiple of the nearest content's,
and at most this multiple of that."""
BETTER = 0.1
"""Correlation of what moves over that of what stands, at least: one neighbour shows each."""
COHERENT = 1.1
"""Steps by which an inverse depth may differ from the median around it."""
SCATTERED, CLOSED, LEAST_PIXELS = 3.0, 13, 450
"""The same within a whole object, pixels across which what moves there is one, and those of an object, at half the
size."""
NEW, UP = 0.5, 0.2
"""Share of an object that is masked already, at most, for it to be another one; and how far below the horizon its
highest pixel lies, over its lowest, at most: what moves by the camera is nearly as high as it."""


@dataclass(frozen=True)
class Carried:
    """The inner part of what a shot shows of what moves in its nearest neighbours. [h, w] each"""

    pixels: Mask
    objects: Mask
    """Whole ones that are not masked yet."""


def carried(shot: Shot, others: Sequence[Neighbour], masks: Sequence[Mask], mask: Mask) -> Carried:
    """What moves in the nearest neighbours of a shot, where the shot shows it.

    Args:
        shot: the image.
        others: its neighbours, nearest first.
        masks: what moves in each. [h, w]
        mask: what moves in the shot, as far as is known. [h, w]
    """
    nothing, measured = np.zeros(shot.view.gray.shape, bool), shot.depth.inverse[shot.depth.inverse > 0]
    if shot.ground is None or not len(measured) or not any(mask.any() for mask in masks[:AFTER]):
        return Carried(nothing, nothing)
    view, nearest = shot.view.reduced(2), float(np.percentile(measured, 98))
    small = view.gray.shape[::-1]
    ground = np.asarray(cv2.resize(shot.ground, small, interpolation=cv2.INTER_NEAREST), np.float32)
    depths = nearest * torch.linspace(BEHIND, BEYOND, DEPTHS)
    least, most = torch.from_numpy(np.maximum(GROUND * ground - MARGIN * nearest, 0)), REACH * nearest

    def best(some: slice, depths: torch.Tensor) -> Likeness:
        views = [other.shot.view.reduced(2) for other in others[some]]
        return most_alike(torch.from_numpy(view.gray), compared(view, views, masks[some]), depths, least, most, False)

    alike, at = best(slice(AFTER), depths)
    stands, moves, inverse = alike[0].numpy(), alike[2].numpy(), at[2].numpy()
    if len(others) > AFTER:
        rest = best(slice(AFTER, STATIC), depths[(depths >= 0) & (depths <= most)])
        stands = np.maximum(stands, rest.alike[0].numpy())
    scatter = np.abs(inverse - cv2.medianBlur(inverse, 5)) / float(depths[1] - depths[0])
    textured = view.inside & (mean_and_contrast(view.gray)[1] > CONTRAST)
    moves = (moves > ALIKE) & (moves > stands + BETTER) & textured
    masked = cv2.resize(mask.astype(np.uint8), small, interpolation=cv2.INTER_NEAREST) > 0
    parts = solid(moves & (scatter <= COHERENT), ground), whole_objects(moves & (scatter <= SCATTERED), ground, masked)
    enlarged = (
        cv2.resize(part.astype(np.uint8), nothing.shape[::-1], interpolation=cv2.INTER_NEAREST) for part in parts
    )
    # Windows reach beyond what moves.
    return Carried(*(cv2.erode(part, np.ones((INSIDE, INSIDE), np.uint8)) > 0 for part in enlarged))


def whole_objects(moves: Mask, ground: Map, masked: Mask) -> Mask:
    """Large objects, not masked yet, on which pixels that move are scattered, as paint has no texture. [h, w]

    Args:
        moves: pixels that move. [h, w]
        ground: inverse depth of the ground, 0 near the horizon and above. [h, w]
        masked: what is known to move. [h, w]
    """
    around = np.pad(moves.astype(np.uint8), CLOSED)
    closed = cv2.morphologyEx(around, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CLOSED, CLOSED)))
    opened = cv2.morphologyEx(closed[CLOSED:-CLOSED, CLOSED:-CLOSED], cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(opened)
    horizon, result = np.count_nonzero((ground == 0).any(1)), np.zeros_like(moves)
    for label in range(1, number):
        part, (_, top, _, height, pixels) = labels == label, boxes[label]
        is_high = top - horizon <= UP * max(top + height - horizon, 0)
        if pixels >= LEAST_PIXELS and is_high and masked[part].mean() < NEW:
            result |= part
    return result
