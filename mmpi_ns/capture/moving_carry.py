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

from mmpi_ns.capture.dense import correlation, mean_and_contrast
from mmpi_ns.capture.moving_evidence import Mask, Neighbour, Shot, Warp
from mmpi_ns.capture.moving_sweep import ALIKE, CONTRAST, INSIDE, solid
from mmpi_ns.capture.views import Map

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
    view = shot.view.reduced(2)
    size, of_view = view.gray.shape[::-1], mean_and_contrast(view.gray)
    ground = np.asarray(cv2.resize(shot.ground, size, interpolation=cv2.INTER_NEAREST), np.float32)
    images = []
    for other, mask in zip(others[:STATIC], masks, strict=False):
        seen = other.shot.view.reduced(2)
        shown = np.where(seen.inside, np.maximum(seen.gray, 1), 0).astype(np.uint8)  # 0: nothing
        moving = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        images.append((shown, moving, Warp.between(view, seen)))
    nearest = float(np.percentile(measured, 98))
    moves, stands = np.full((2, *view.gray.shape), -1, np.float32)
    inverse = np.zeros_like(moves)
    depths = nearest * np.linspace(BEHIND, BEYOND, DEPTHS, dtype=np.float32)
    for q in depths:
        possible = (q >= 0) & (q <= REACH * nearest) & (q >= GROUND * ground - MARGIN * nearest)
        for n, (shown, moving, warp) in enumerate(images):
            follows = n < AFTER and moving.any()
            if not follows and not possible.any():
                continue
            x, y, ahead = warp.places(np.full_like(moves, q))
            gray = np.asarray(cv2.remap(shown, x, y, cv2.INTER_LINEAR), np.uint8)
            alike = correlation(view.gray, gray, of_view)
            alike[(gray == 0) | (ahead <= 0)] = -1
            is_moving = cv2.remap(moving, x, y, cv2.INTER_NEAREST) > 0
            _raise(stands, alike, possible & ~is_moving)
            if follows:
                inverse[_raise(moves, alike, is_moving)] = q
    coherent = np.abs(inverse - cv2.medianBlur(inverse, 5)) <= COHERENT * (depths[1] - depths[0])
    textured = view.inside & (of_view[1] > CONTRAST)
    whole = solid((moves > ALIKE) & (moves > stands + BETTER) & textured & coherent, ground).astype(np.uint8)
    whole = cv2.resize(whole, nothing.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return cv2.erode(whole, np.ones((INSIDE, INSIDE), np.uint8)) > 0  # windows reach beyond what moves


def _raise(best: Map, values: Map, where: Mask) -> Mask:
    """Takes the larger of two values, in place, at some pixels; those where it rose. [h, w] each"""
    better = where & (values > best)
    best[better] = values[better]
    return better
