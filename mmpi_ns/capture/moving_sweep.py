"""What moves along with the camera or towards it, by depths that nothing static can have.

Something that moves parallel to the camera's path is seen as a static thing is, but at a wrong inverse depth: q (1 - v),
with v its speed over the camera's. A car ahead that keeps its distance seems infinitely far, below the road; one that
overtakes seems to lie behind the camera; one that comes towards it seems nearer and smaller than it is, and hangs in the
air. So each image is compared with its neighbours at a range of inverse depths that reaches below 0, at half the size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mmpi_ns.capture.dense import Parallax, correlation, mean_and_contrast
from mmpi_ns.capture.moving_evidence import Mask, Neighbour, Shot
from mmpi_ns.capture.views import Map, View, look_up

NEIGHBOURS, CONFIRM = 4, 2
"""Nearest neighbours that are compared, and those whose correlations count, the best at each depth."""
NEGATIVE, POSITIVE, REACH = 24, 48, 1.2
"""Inverse depths behind the camera and before it, up to this multiple of the nearest content's; half of it behind."""
BELOW, MARGIN = 0.6, 0.02
"""An inverse depth is impossible below this multiple of the ground's less this multiple of the largest."""
ALIKE, BETTER, CONTRAST = 0.8, 0.15, 3.0
"""Correlation at an impossible depth, what it has over the best possible one, and standard deviation of gray levels
around a pixel, at least, for the pixel to move."""
COHERENT = 1.1
SMOOTH, LEAST_PIXELS, STANDS = 5, 30, 0.3
"""Pixels across which most must move, pixels of what moves, and share of them below the horizon, at half the size."""


@dataclass(frozen=True)
class Sweep:
    """Where the neighbours look most alike. [h, w] each, at half the size"""

    inverse: Map
    """Inverse depth, also negative; 0 where nothing is alike."""
    impossible: Mask
    """Where only an impossible inverse depth is alike."""


def halved(view: View) -> View:
    """A view at half its size."""
    height, width = (n // 2 for n in view.gray.shape)
    scale = np.array([width / view.gray.shape[1], height / view.gray.shape[0]] * 2)
    inside = cv2.resize(view.inside.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    gray = cv2.resize(view.gray, (width, height), interpolation=cv2.INTER_AREA)
    return View(np.asarray(gray, np.uint8), view.pinhole * scale, view.pose, inside)


def sweep(shot: Shot, others: Sequence[Neighbour]) -> Sweep | None:
    """Compares a shot with its neighbours at depths that static things may have, and others; None without a ground."""
    measured = shot.depth.inverse[shot.depth.inverse > 0]
    if shot.ground is None or not len(measured) or len(others) < CONFIRM:
        return None
    view, largest = halved(shot.view), REACH * float(np.percentile(measured, 98))
    shape = view.gray.shape
    ground = cv2.resize(shot.ground, shape[::-1], interpolation=cv2.INTER_NEAREST)
    least = BELOW * ground - MARGIN * largest
    of_view = mean_and_contrast(view.gray)
    near = [halved(other.shot.view) for other in others[:NEIGHBOURS]]
    parallax = [Parallax.between(view, other) for other in near]
    moves, stands = np.full((2, *shape), -1, np.float32)
    inverse, best, wrong = np.zeros((3, *shape), np.float32)
    behind = np.linspace(-largest / 2, 0, NEGATIVE, endpoint=False)
    for q in np.concatenate([behind, np.linspace(0, largest, POSITIVE)]).astype(np.float32):
        alike = []
        for other, there in zip(near, parallax, strict=True):
            x, y, ahead = there.pixels(np.full(shape, q))
            height, width = other.gray.shape
            inside = (x > 0.5) & (x < width - 0.5) & (y > 0.5) & (y < height - 0.5) & (ahead > 0)
            alike.append(np.where(inside, correlation(view.gray, look_up(other.gray, x, y), of_view), -1))
        both = np.sort(np.stack(alike), 0)[-CONFIRM:].mean(0)
        impossible = q < least
        np.copyto(wrong, q, where=impossible & (both > moves))
        np.maximum(moves, both, out=moves, where=impossible)
        np.maximum(stands, both, out=stands, where=~impossible)
        np.copyto(inverse, q, where=both > best)
        np.maximum(best, both, out=best)
    step = largest / POSITIVE
    coherent = np.abs(wrong - cv2.medianBlur(wrong, 5)) <= COHERENT * step
    textured = view.inside & (of_view[1] > CONTRAST)
    impossible = (moves > ALIKE) & (stands < moves - BETTER) & textured & coherent
    return Sweep(np.where((best > 0.7) & (of_view[1] > 2.0), inverse, 0), solid(impossible, ground))


def solid(moves: Mask, ground: Map) -> Mask:
    """What moves without specks, lines, and what does not reach below the horizon. [h, w]"""
    filled = cv2.boxFilter(moves.astype(np.float32), -1, (SMOOTH, SMOOTH)) > 0.5
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(filled.astype(np.uint8))
    stands = np.bincount(labels.ravel(), (ground > 0).ravel(), number) / boxes[:, cv2.CC_STAT_AREA]
    kept = (boxes[:, cv2.CC_STAT_AREA] >= LEAST_PIXELS) & (stands > STANDS)
    kept[0] = False
    return kept[labels]


FLOATS = 1.4
"""Inverse depth of a thing over that of the ground just below it, at least, for it to hang in the air."""
EDGE, PIECE = 1.25, 20
"""Factor by which inverse depths next to each other differ at the edge of a thing, and pixels of one, at least."""
GAP, BARE = 12, 0.6
"""Pixels below it in which the first known depth must be the ground's, and share of its columns where it is."""
STRAIGHT = 0.05
"""Distance of cameras from a straight line over the length of their path, at most: else depths are what they seem."""
FAR = 1e30


def floats(shot: Shot, others: Sequence[Neighbour], inverse: Map) -> Mask:
    """What seems to hang in the air, as a car does that comes towards a camera: nearer than it is, and smaller. [h, w]

    A camera that goes straight on cannot tell it from a static thing but by where it stands.
    """
    result = np.zeros(inverse.shape, bool)
    centers = np.stack([s.view.pose[:, 3] for s in (shot, *(other.shot for other in others))])
    sizes = np.linalg.svd(centers - centers.mean(0), compute_uv=False)
    if shot.ground is None or len(centers) < 3 or sizes[1] > STRAIGHT * sizes[0]:
        return result
    ground = cv2.resize(shot.ground, inverse.shape[::-1], interpolation=cv2.INTER_NEAREST)
    inverse = cv2.medianBlur(np.maximum(inverse, 0), 5)
    kernel = np.ones((3, 3), np.uint8)
    smallest = cv2.erode(np.where(inverse > 0, inverse, FAR).astype(np.float32), kernel)
    whole = cv2.dilate(inverse, kernel) < EDGE * smallest  # things end where depth jumps
    stands = (inverse > FLOATS * ground) & (inverse > 0) & whole
    on_ground = (inverse > 0) & (np.abs(inverse - ground) < 0.2 * ground)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(stands.astype(np.uint8))
    for label in np.flatnonzero(boxes[:, cv2.CC_STAT_AREA] >= PIECE)[1:]:
        left, top, width, height = boxes[label, :4]
        window = np.s_[top : top + height + GAP, left : left + width]
        part = labels[window] == label
        last = len(part) - 1 - part[::-1].argmax(0)
        columns = np.flatnonzero(part.any(0))
        below = np.arange(len(part))[:, None] > last[columns]
        shown = ((inverse > 0) & whole)[window][:, columns] & below
        first = shown.argmax(0)
        bare = shown.any(0) & on_ground[window][first, columns] & (ground[window][last[columns], columns] > 0)
        if bare.mean() > BARE:
            result[top : top + len(part), left : left + width] |= part
    return result
