"""What moves along the camera's path, followed into images in which too few neighbours show what is behind it.

A car that leaves an image at the side, or has just entered it, is large there, moves across much of the image from one
to the next, and hides what no other image shows. But as it moves parallel to the path, it has one inverse depth in all
images, if a false one (``moving_sweep.py``). So what moves in a neighbour is searched at inverse depths from behind the
camera to beyond the nearest content, by correlation at half the size. It counts where it is clearly more alike than
anything that stands in any neighbour, at a depth that something static may have.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from mmpi_ns.capture.dense import mean_and_contrast
from mmpi_ns.capture.moving_evidence import Mask, Neighbour, Shot
from mmpi_ns.capture.moving_sweep import ALIKE, CONTRAST, INSIDE, compared, solid
from mmpi_ns.ops.likeness import Likeness, most_alike

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


def carried(shot: Shot, others: Sequence[Neighbour], masks: Sequence[Mask]) -> Mask:
    """The inner part of what a shot shows of what moves in its nearest neighbours. [h, w]

    Args:
        shot: the image.
        others: its neighbours, nearest first.
        masks: what moves in each. [h, w]
    """
    nothing, measured = np.zeros(shot.view.gray.shape, bool), shot.depth.inverse[shot.depth.inverse > 0]
    if shot.ground is None or not len(measured) or not any(mask.any() for mask in masks[:AFTER]):
        return nothing
    view, nearest = shot.view.reduced(2), float(np.percentile(measured, 98))
    ground = np.asarray(cv2.resize(shot.ground, view.gray.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
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
    coherent = np.abs(inverse - cv2.medianBlur(inverse, 5)) <= COHERENT * float(depths[1] - depths[0])
    textured = view.inside & (mean_and_contrast(view.gray)[1] > CONTRAST)
    whole = solid((moves > ALIKE) & (moves > stands + BETTER) & textured & coherent, ground).astype(np.uint8)
    whole = cv2.resize(whole, nothing.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return cv2.erode(whole, np.ones((INSIDE, INSIDE), np.uint8)) > 0  # windows reach beyond what moves
