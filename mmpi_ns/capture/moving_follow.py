"""People who move, followed from image to image by what they look like.

Somebody who walks ahead of the camera looks like a static thing far away, and optical flow is lost where the camera
turns. So objects that are taller than wide are searched around their place in images that are turned alike, at a few
sizes, by normalised correlation (``cv2.matchTemplate``) at half the size. What is seen there moves if no depth that
something static can have brings it there. It is followed on from there, in both directions, until it is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mmpi_ns.capture.moving_evidence import SOLID, Bytes, Mask, Shot, Warp
from mmpi_ns.capture.views import View

AFTER, IMAGES = 4, 5
"""Nearest neighbours from which objects are followed, and images through which they are."""
ASIDE, UP = 0.12, 0.05
"""Places around its own in which an object is searched, in widths of the image."""
SIZES = (0.87, 1.0, 1.15)
"""Over its size in the neighbour, at which an object is searched."""
ALIKE = 0.75
"""Correlation of colours from which an object is seen."""
LEAST_AREA, LEAST_SIDE = 30, 4
"""Pixels of an object and of its width, at least."""
DEPTHS, REACH, APART = 24, 1.2, 1.5
"""Inverse depths that something static may have, up to this multiple of the nearest content's, and pixels between where
they put an object and where it was, from which on it moves."""
INNER = 3
"""Pixels across which an object is shrunk: its outline is uncertain."""
THERE = 0.9
"""Share of an object that is masked anyway, up to which it is followed on."""


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

    @staticmethod
    def of(shot: Shot) -> Half:
        view, measured = shot.view.reduced(2), shot.depth.inverse[shot.depth.inverse > 0]
        height, width = view.gray.shape
        ground = np.zeros((height, width), np.float32) if shot.ground is None else shot.ground
        ground = np.asarray(cv2.resize(ground, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)
        color = np.asarray(cv2.resize(shot.color, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        return Half(view, color, shot.color, float(np.percentile(measured, 98)) if len(measured) else 0.0, ground)


def upright_objects(
    shots: Sequence[Shot], near: Sequence[Sequence[int]], masks: Sequence[Mask], pool: ThreadPoolExecutor
) -> list[Mask]:
    """Where each shot shows what moves in others and is taller than wide, but for the outline. [h, w] each

    Args:
        shots: the images.
        near: the neighbours of each, nearest first.
        masks: what moves in each. [h, w]
        pool: for several images at a time.
    """
    if not any(mask.any() for mask in masks):
        return [np.zeros_like(mask) for mask in masks]
    halves = list(pool.map(Half.of, shots))
    there = [cv2.resize(m.astype(np.uint8), h.view.gray.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
             for m, h in zip(masks, halves, strict=True)]  # fmt: skip
    every, fresh = [np.zeros_like(mask) for mask in there], list(there)

    def seen_in(i: int) -> tuple[Mask, Mask]:
        return _seen(halves[i], [(halves[j], fresh[j]) for j in near[i][:AFTER]], there[i] | every[i])

    for _ in range(IMAGES):
        seen = list(pool.map(seen_in, range(len(shots))))
        every = [mask | now for mask, (now, _) in zip(every, seen, strict=True)]
        fresh = [new for _, new in seen]
        if not any(mask.any() for mask in fresh):
            break
    return [cv2.resize(mask.astype(np.uint8), full.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
            for mask, full in zip(every, masks, strict=True)]  # fmt: skip


def _seen(shot: Half, others: Sequence[tuple[Half, Mask]], masked: Mask) -> tuple[Mask, Mask]:
    """Where a shot shows objects of others, and where those are not masked yet. [h, w] each"""
    every, new = np.zeros((2, *masked.shape), bool)
    for other, moves in others:
        for part in objects_in(shot, other, moves) if moves.any() else ():
            every |= part
            if masked[part].mean() < THERE:
                new |= part
    return every, new


def objects_in(shot: Half, other: Half, moves: Mask) -> list[Mask]:
    """Where a shot shows each of the objects that move in another one, if it does. [h, w] each"""
    height, width = shot.view.gray.shape
    warp = Warp.between(shot.view, other.view)
    x, y, ahead = warp.places(np.zeros((height, width), np.float32))
    turned = cv2.remap(moves.astype(np.uint8), x, y, cv2.INTER_NEAREST) * (ahead > 0)
    color = np.asarray(
        cv2.remap(other.full, 2 * x + 0.5, 2 * y + 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )
    number, labels, boxes, centers = cv2.connectedComponentsWithStats(turned)
    result = []
    for label in range(1, number):
        left, top, wide, high, area = (int(n) for n in boxes[label])
        if area < LEAST_AREA or not LEAST_SIDE <= wide <= high:
            continue
        box = np.s_[top : top + high, left : left + wide]
        shape = labels[box] == label
        place = search(shot.color, color[box], shape, (left, top))
        if place is None:
            continue
        size, column, row = place
        outline = cv2.resize(shape.astype(np.uint8), None, fx=size, fy=size, interpolation=cv2.INTER_NEAREST)
        rows, columns = outline.shape
        middle = (centers[label] - (left, top)) * size + (column, row)
        if _may_stand(shot, warp, middle, centers[label], row + rows - 1):
            continue
        part = np.zeros((height, width), np.uint8)
        part[row : row + rows, column : column + columns] = outline
        part = cv2.erode(part, np.ones((INNER, INNER), np.uint8), borderValue=1) > 0
        if part.any():
            result.append(part)
    return result


def search(image: Bytes, color: Bytes, shape: Mask, corner: tuple[int, int]) -> tuple[float, int, int] | None:
    """The size of an object over what it was, and the column and row of its box in an image; None if it is not seen.

    Args:
        image: in which it is searched. [h, w, 3]
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


def _may_stand(shot: Half, warp: Warp, here: NDArray[np.float64], there: NDArray[np.float64], bottom: int) -> bool:
    """Whether something static may be at one pixel of a shot and at another one of a neighbour that is turned alike.

    Args:
        shot: the image.
        warp: to the neighbour.
        here: column and row of the middle of an object in the shot.
        there: column and row in the neighbour, turned alike.
        bottom: last row of the object in the shot.
    """
    height, width = shot.view.gray.shape
    (column, row), before = (
        tuple(int(np.clip(c, 0, n - 1)) for c, n in zip(at, (width, height), strict=True)) for at in (here, there)
    )
    least = SOLID * float(shot.ground[min(bottom, height - 1), column])
    inverse = np.linspace(least, max(least, REACH * shot.nearest), DEPTHS, dtype=np.float32)[:, None]
    x, y, ahead = warp.at((np.array([row]), np.array([column])), DEPTHS).places(inverse)
    was = warp.at((np.array([before[1]]), np.array([before[0]])), 1).places(np.zeros((1, 1), np.float32))
    return bool((np.hypot(x - was[0], y - was[1])[ahead > 0] < APART).any())
