"""Tracking of people from image to image by template matching.

A person who walks ahead of the camera looks like a distant static object, and optical flow fails where the camera
turns. There, tall objects of neighbouring images are tracked by template matching after rotation compensation, at a few
scales and half the size (``cv2.matchTemplate``). A match moves if no possible static depth projects it there, and
counts if it moves in two images.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mmpi_priors.moving_evidence import SOLID, Bytes, Mask, Shot, Warp, turned
from mmpi_priors.views import View

AFTER = 4
"""Nearest neighbours from which objects are tracked, if the camera turned relative to one of them."""
ASIDE, UP = 0.12, 0.05
"""Search radius around the position of an object, in widths of the image."""
SIZES = (0.87, 1.0, 1.15)
"""Scales relative to the neighbour at which an object is searched."""
ALIKE = 0.75
"""Minimum correlation of colours for a match."""
LEAST_AREA, LEAST_SIDE = 30, 4
"""Minimum number of pixels and minimum width of an object."""
DEPTHS, REACH, APART = 24, 1.2, 1.5
"""Maximum inverse depth of static objects, as a multiple of the nearest content's; and minimum distance, in pixels, of
a moving object from its possible static positions."""
INNER = 2
"""Pixels across which an object is shrunk at half the size: its outline is uncertain."""
AGAIN = 0.5
"""Minimum share of a tracked object that is masked independently in some image: a single detection may be wrong."""


@dataclass(frozen=True)
class Half:
    """A shot at half its size."""

    view: View
    color: Bytes
    """[h, w, 3]"""
    full: Bytes
    """Its colours at full size."""
    nearest: float
    """Inverse depth of the nearest content."""
    ground: NDArray[np.float32]
    """Its inverse depth, 0 where there is none. [h, w]"""
    objects: NDArray[np.int16]
    """Number of the object that moves there, from 1 on. [h, w]"""

    @staticmethod
    def of(shot: Shot, is_moving: Mask) -> Half:
        view, measured = shot.view.reduced(2), shot.depth.inverse[shot.depth.inverse > 0]
        height, width = view.gray.shape
        ground = np.zeros((height, width), np.float32) if shot.ground is None else shot.ground
        ground = np.asarray(cv2.resize(ground, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)
        color = np.asarray(cv2.resize(shot.color, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        small = cv2.resize(is_moving.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        objects = cv2.connectedComponents(small, ltype=cv2.CV_16U)[1].astype(np.int16)
        nearest = float(np.percentile(measured, 98)) if len(measured) else 0.0
        return Half(view, color, shot.color, nearest, ground, objects)


def upright_objects(
    shots: Sequence[Shot], near: Sequence[Sequence[int]], masks: Sequence[Mask], pool: ThreadPoolExecutor
) -> list[Mask]:
    """Tall objects that move in other shots (``masks`` of each), at their positions in each shot, without their
    outlines. [h, w] each. ``near`` are the neighbours of each, nearest first."""
    result = [np.zeros_like(mask) for mask in masks]
    if not any(mask.any() for mask in masks):
        return result
    halves, pairs = list(pool.map(Half.of, shots, masks)), []
    for i, nearest in enumerate(others[:AFTER] for others in near):
        if any(turned(shots[i].view, shots[j].view) for j in nearest):
            pairs += [(i, j) for j in nearest]
    objects = pool.map(lambda pair: objects_in(halves[pair[0]], halves[pair[1]]), pairs)
    seen = [(i, (j, label), part) for (i, j), parts in zip(pairs, objects, strict=True) for label, part in parts]
    again = {mover for i, mover, part in seen if (halves[i].objects[part] > 0).mean() > AGAIN}
    for i, size in enumerate(mask.shape[::-1] for mask in masks):
        parts = [part for shot, mover, part in seen if shot == i and mover in again]
        if parts:
            every = np.any(parts, axis=0).astype(np.uint8)
            result[i] = cv2.resize(every, size, interpolation=cv2.INTER_NEAREST) > 0
    return result


def objects_in(shot: Half, other: Half) -> list[tuple[int, Mask]]:
    """Objects of another image that a shot sees: their numbers there, and their masks in the shot. [h, w] each"""
    height, width = shot.view.gray.shape
    warp = Warp.between(shot.view, other.view)
    x, y, ahead = warp.places(np.zeros((height, width), np.float32))
    turned = cv2.remap(other.objects, x, y, cv2.INTER_NEAREST) * (ahead > 0)
    if not turned.any():
        return []
    color = cv2.remap(other.full, 2 * x + 0.5, 2 * y + 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    result = []
    for label in np.setdiff1d(turned, [0]):
        rows, columns = np.nonzero(turned == label)
        left, top, right, bottom = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
        if len(rows) < LEAST_AREA or not LEAST_SIDE <= right - left <= bottom - top:
            continue
        box = np.s_[top:bottom, left:right]
        shape = turned[box] == label
        place = search(shot.color, np.asarray(color[box], np.uint8), shape, (int(left), int(top)))
        if place is None:
            continue
        size, first, above = place
        outline = cv2.resize(shape.astype(np.uint8), None, fx=size, fy=size, interpolation=cv2.INTER_NEAREST)
        before = np.array([columns.mean(), rows.mean()])
        middle = (before - (left, top)) * size + (first, above)
        # A static object at a possible depth may explain both positions.
        last = np.array([width - 1, height - 1])
        (column, row), was = (np.clip(at, 0, last).astype(int) for at in (middle, before))
        least = SOLID * float(shot.ground[min(above + len(outline), height) - 1, column])
        inverse = np.linspace(least, max(least, REACH * shot.nearest), DEPTHS, dtype=np.float32)[:, None]
        x, y, ahead = warp.at((np.array([row]), np.array([column])), DEPTHS).places(inverse)
        far_x, far_y, _ = warp.at((was[1:], was[:1]), 1).places(np.zeros((1, 1), np.float32))
        if (np.hypot(x - far_x, y - far_y)[ahead > 0] < APART).any():
            continue
        part = np.zeros((height, width), np.uint8)
        part[above : above + outline.shape[0], first : first + outline.shape[1]] = outline
        part = cv2.erode(part, np.ones((INNER, INNER), np.uint8)) > 0
        if part.any():
            result.append((int(label), part))
    return result


def search(image: Bytes, color: Bytes, shape: Mask, corner: tuple[int, int]) -> tuple[float, int, int] | None:
    """Scale of an object, and column and row of its box in an image; None if it is not seen.

    Args:
        image: to search. [h, w, 3]
        color: the box with the object. [b, c, 3]
        shape: the object in the box. [b, c]
        corner: column and row of the box, turned like the image.
    """
    width = image.shape[1]
    aside, up = round(ASIDE * width), round(UP * width)
    best, place = ALIKE, None
    for size in SIZES:
        part = cv2.resize(color, None, fx=size, fy=size, interpolation=cv2.INTER_AREA)
        weight = cv2.resize(shape.astype(np.uint8), None, fx=size, fy=size, interpolation=cv2.INTER_NEAREST)
        rows, columns = weight.shape
        left, top = (round(at + (1 - size) * n / 2) for at, n in zip(corner, shape.shape[::-1], strict=True))
        first, above = max(0, left - aside), max(0, top - up)
        window = image[above : top + rows + up, first : left + columns + aside]
        if window.shape[0] < rows or window.shape[1] < columns or not weight.any():
            continue
        alike = cv2.matchTemplate(window, part, cv2.TM_CCOEFF_NORMED, mask=cv2.merge([weight] * 3))
        alike = np.where(np.isfinite(alike) & (alike < 1.001), alike, -1)  # flat places give anything
        row, column = np.unravel_index(int(alike.argmax()), alike.shape)
        if alike[row, column] > best:
            best, place = float(alike[row, column]), (size, first + int(column), above + int(row))
    return place
