"""What moves along with the camera or towards it, by depths that nothing static can have.

Something that moves parallel to the camera's path looks like a static thing at a wrong inverse depth: its own times
1 - v, with v its speed over the camera's. A car ahead that keeps its distance seems infinitely far, below the road; one
that overtakes seems to lie behind the camera; one that comes towards it seems nearer and smaller than it is, so that it
hangs in the air. So a shot is compared with its neighbours at inverse depths that reach below 0, at half its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from mmpi_priors.dense import mean_and_contrast
from mmpi_priors.moving_evidence import Mask, Neighbour, Shot
from mmpi_priors.ops.likeness import most_alike
from mmpi_priors.ops.patches import Others, others_of
from mmpi_priors.views import Map, Parallax, View

NEIGHBOURS = 4
"""Nearest neighbours that are compared; the mean of the two best correlations counts at each depth."""
NEGATIVE, POSITIVE, REACH = 24, 48, 1.2
"""Inverse depths behind the camera and before it, up to this multiple of the nearest content's; half of it behind."""
BELOW, MARGIN = 0.6, 0.02
"""An inverse depth is impossible below this multiple of the ground's less this multiple of the largest."""
ALIKE, BETTER, CONTRAST = 0.8, 0.15, 3.0
"""Correlation at an impossible depth, what it has over the best possible one, and standard deviation of gray levels
around a pixel, at least, for the pixel to move."""
COHERENT = 1.1
"""Steps by which the impossible depth may differ from the median around it: chance makes scattered ones."""
SMOOTH, LEAST_PIXELS, STANDS = 5, 30, 0.3
"""Pixels across which most must move, pixels of what moves, and share of them below the horizon, at half the size."""
INSIDE = 11
"""Pixels across which all must move, at the size of the shot: windows reach beyond what moves."""
MEASURED, MEASURED_CONTRAST = 0.7, 2.0
"""Correlation and contrast from which a depth is taken for what hangs in the air."""
FLOATS = 1.4
"""Inverse depth of a thing over that of the ground just below it, at least, for it to hang in the air."""
EDGE, PIECE = 1.25, 20
"""Factor by which inverse depths next to each other differ at the edge of a thing, and pixels of one, at least."""
GAP, ON_GROUND, BARE = 12, 0.2, 0.6
"""Pixels below it in which the first measured depth must be the ground's but for this share, and share of its columns
where it is."""
STRAIGHT = 0.05
"""Distance of cameras from a straight line over the length of their path, at most: else depths are what they seem."""
FAR = 1e30


@dataclass(frozen=True)
class Sweep:
    """Where a shot shows what moves parallel to the camera's path. [h, w] each"""

    impossible: Mask
    """Neighbours look alike at a depth below the ground or behind the camera, and at no possible one."""
    certain: Mask
    """The inner part of it, and what hangs in the air."""


def sweep(shot: Shot, others: Sequence[Neighbour]) -> Sweep:
    """Compares a shot with its neighbours at depths that static things may have, and at others."""
    nothing, measured = np.zeros(shot.view.gray.shape, bool), shot.depth.inverse[shot.depth.inverse > 0]
    if shot.ground is None or not len(measured) or len(others) < 2:
        return Sweep(nothing, nothing)
    view, largest = shot.view.reduced(2), REACH * float(np.percentile(measured, 98))
    ground = np.asarray(cv2.resize(shot.ground, view.gray.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
    contrast, step = mean_and_contrast(view.gray)[1], largest / POSITIVE
    depths = step * torch.arange(-NEGATIVE, POSITIVE + 1)
    least = torch.from_numpy(BELOW * ground - MARGIN * largest)
    near = compared(view, [other.shot.view.reduced(2) for other in others[:NEIGHBOURS]])
    alike, at = most_alike(torch.from_numpy(view.gray), near, depths, least, np.inf, True)
    (stands, moves, _), (possible, false, _) = alike.numpy(), at.numpy()
    inverse = np.where(moves >= stands, false, possible)
    inverse = np.where((np.maximum(moves, stands) > MEASURED) & (contrast > MEASURED_CONTRAST), inverse, 0)
    coherent = np.abs(false - cv2.medianBlur(false, 5)) <= COHERENT * step
    textured = view.inside & (contrast > CONTRAST)
    below = (moves > ALIKE) & (stands < moves - BETTER) & textured & coherent
    views = [shot.view, *(other.shot.view for other in others)]
    air = floats(inverse, ground) if is_straight(views) else np.zeros_like(below)
    below, air = (
        cv2.resize(mask.astype(np.uint8), nothing.shape[::-1], interpolation=cv2.INTER_NEAREST)
        for mask in (solid(below, ground), air)
    )
    inner = cv2.erode(below, np.ones((INSIDE, INSIDE), np.uint8))
    return Sweep(below > 0, (inner > 0) | (air > 0))


def compared(view: View, others: Sequence[View], masks: Sequence[Mask] | None = None) -> Others:
    """Other views, and as marks what moves in them, as a view is compared with them (``most_alike``)."""
    images = []
    for other, mask in zip(others, masks or [np.zeros((1, 1), bool)] * len(others), strict=True):
        moving = cv2.resize(mask.astype(np.uint8), other.gray.shape[::-1], interpolation=cv2.INTER_NEAREST)
        both = np.where(other.inside, np.maximum(other.gray, 1), 0), moving  # 0: nothing
        images.append([torch.from_numpy(np.pad(np.asarray(image, np.uint8), 1)) for image in both])
    linear, b = zip(*(Parallax.between(view, other).tensors for other in others), strict=True)
    return others_of(images, torch.stack(linear), torch.stack(b))


def solid(moves: Mask, ground: Map) -> Mask:
    """What moves without specks, lines, and what does not reach below the horizon. [h, w]"""
    filled = cv2.boxFilter(moves.astype(np.float32), -1, (SMOOTH, SMOOTH)) > 0.5
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(filled.astype(np.uint8))
    stands = np.bincount(labels.ravel(), (ground > 0).ravel(), number) / boxes[:, cv2.CC_STAT_AREA]
    kept = (boxes[:, cv2.CC_STAT_AREA] >= LEAST_PIXELS) & (stands > STANDS)
    kept[0] = False
    return kept[np.asarray(labels, np.int64)]


def is_straight(views: Sequence[View]) -> bool:
    """Whether cameras stand on a straight line: then one thing that moves along it has one false depth in all."""
    centers = np.stack([view.pose[:, 3] for view in views])
    sizes = np.linalg.svd(centers - centers.mean(0), compute_uv=False)
    return len(centers) >= 3 and bool(sizes[1] <= STRAIGHT * sizes[0])


def floats(inverse: Map, ground: Map) -> Mask:
    """What seems to hang in the air, as a car does that comes towards the camera: nearer than it is, and smaller.

    Args:
        inverse: inverse depth, 0 or less where unknown. [h, w]
        ground: inverse depth of the ground, 0 near the horizon and above. [h, w]
    """
    result = np.zeros(inverse.shape, bool)
    inverse = np.asarray(cv2.medianBlur(np.maximum(inverse, 0), 5), np.float32)
    kernel = np.ones((3, 3), np.uint8)
    smallest = cv2.erode(np.where(inverse > 0, inverse, FAR).astype(np.float32), kernel)
    whole = (inverse > 0) & (cv2.dilate(inverse, kernel) < EDGE * smallest)  # things end where depth jumps
    on_ground = np.abs(inverse - ground) < ON_GROUND * ground
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(((inverse > FLOATS * ground) & whole).astype(np.uint8))
    for label in np.flatnonzero(boxes[:, cv2.CC_STAT_AREA] >= PIECE)[1:]:
        left, top, width, height = boxes[label, :4]
        window = np.s_[top : top + height + GAP, left : left + width]
        part = labels[window] == label
        last = len(part) - 1 - part[::-1].argmax(0)
        columns = np.arange(part.shape[1])
        shown = whole[window] & (np.arange(len(part))[:, None] > last)
        first = shown.argmax(0)
        bare = shown.any(0) & on_ground[window][first, columns] & (ground[window][last, columns] > 0)
        if bare[part.any(0)].mean() > BARE:
            result[window] |= part
    return result
