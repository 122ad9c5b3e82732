"""Detection of objects that move parallel to the camera, by apparent depths that are impossible for static points.

An object that moves parallel to the camera's path looks like a static one at the inverse depth (1 - v) q, with q its
own and v its speed relative to the camera's. A car ahead at constant distance appears infinitely far, below the road;
one that overtakes appears behind the camera; an approaching one appears nearer and smaller than it is, floating in the
air. So a shot is compared with its neighbours at inverse depths that reach below 0, at half its size.
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
"""Number of inverse depths behind and in front of the camera, up to this multiple of the nearest content's; half of it
behind."""
BELOW, MARGIN = 0.6, 0.02
"""An inverse depth is impossible below this multiple of the ground's less this multiple of the largest."""
ALIKE, BETTER, CONTRAST = 0.8, 0.15, 3.0
"""Minimum correlation at an impossible depth, its margin over the best possible one, and minimum standard deviation of
gray levels, for a moving pixel."""
COHERENT = 1.1
"""Maximum difference of an impossible depth from the median around it, in steps: random matches scatter."""
SMOOTH, LEAST_PIXELS, STANDS = 5, 30, 0.3
"""Window in which most pixels must move, minimum size of an object, and its minimum share below the horizon, at half
the size."""
INSIDE = 11
"""Size of the erosion at full size: windows reach beyond the object."""
MEASURED, MEASURED_CONTRAST = 0.7, 2.0
"""Minimum correlation and contrast of depths of floating objects."""
FLOATS = 1.4
"""Minimum ratio of the inverse depths of a floating object and the ground just below it."""
EDGE, PIECE = 1.25, 20
"""Factor between adjacent inverse depths at the edge of an object, and minimum size of one."""
GAP, ON_GROUND, BARE = 12, 0.2, 0.6
"""Distance below it within which the first measured depth must be the ground's, relative tolerance, and minimum share
of its columns."""
STRAIGHT = 0.05
"""Maximum distance of the cameras from a straight line, relative to the length of their path."""
FAR = 1e30


@dataclass(frozen=True)
class Sweep:
    """Pixels of objects that move parallel to the camera's path. [h, w] each"""

    impossible: Mask
    """Pixels that match at a depth below the ground or behind the camera, and at no possible one."""
    certain: Mask
    """The inner part of it, and floating objects."""


def sweep(shot: Shot, others: Sequence[Neighbour]) -> Sweep:
    """Plane sweep of a shot against its neighbours, at possible and impossible depths."""
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
    (stands, is_moving, _), (possible, false, _) = alike.numpy(), at.numpy()
    inverse = np.where(is_moving >= stands, false, possible)
    inverse = np.where((np.maximum(is_moving, stands) > MEASURED) & (contrast > MEASURED_CONTRAST), inverse, 0)
    coherent = np.abs(false - cv2.medianBlur(false, 5)) <= COHERENT * step
    textured = view.inside & (contrast > CONTRAST)
    below = (is_moving > ALIKE) & (stands < is_moving - BETTER) & textured & coherent
    views = [shot.view, *(other.shot.view for other in others)]
    air = floats(inverse, ground) if is_straight(views) else np.zeros_like(below)
    below, air = (
        cv2.resize(mask.astype(np.uint8), nothing.shape[::-1], interpolation=cv2.INTER_NEAREST)
        for mask in (solid(below, ground), air)
    )
    inner = cv2.erode(below, np.ones((INSIDE, INSIDE), np.uint8))
    return Sweep(below > 0, (inner > 0) | (air > 0))


def compared(view: View, others: Sequence[View], masks: Sequence[Mask] | None = None) -> Others:
    """Other views with their moving objects as marks, for ``most_alike``."""
    images = []
    for other, mask in zip(others, masks or [np.zeros((1, 1), bool)] * len(others), strict=True):
        moving = cv2.resize(mask.astype(np.uint8), other.gray.shape[::-1], interpolation=cv2.INTER_NEAREST)
        both = np.where(other.inside, np.maximum(other.gray, 1), 0), moving  # 0: nothing
        images.append([torch.from_numpy(np.pad(np.asarray(image, np.uint8), 1)) for image in both])
    linear, b = zip(*(Parallax.between(view, other).tensors for other in others), strict=True)
    return others_of(images, torch.stack(linear), torch.stack(b))


def solid(is_moving: Mask, ground: Map) -> Mask:
    """Moving pixels without specks, lines and objects that do not reach below the horizon. [h, w]"""
    filled = cv2.boxFilter(is_moving.astype(np.float32), -1, (SMOOTH, SMOOTH)) > 0.5
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(filled.astype(np.uint8))
    stands = np.bincount(labels.ravel(), (ground > 0).ravel(), number) / boxes[:, cv2.CC_STAT_AREA]
    kept = (boxes[:, cv2.CC_STAT_AREA] >= LEAST_PIXELS) & (stands > STANDS)
    kept[0] = False
    return kept[np.asarray(labels, np.int64)]


def is_straight(views: Sequence[View]) -> bool:
    """Whether cameras stand on a straight line: an object that moves along it then has one apparent depth in all."""
    centers = np.stack([view.pose[:, 3] for view in views])
    sizes = np.linalg.svd(centers - centers.mean(0), compute_uv=False)
    return len(centers) >= 3 and bool(sizes[1] <= STRAIGHT * sizes[0])


def floats(inverse: Map, ground: Map) -> Mask:
    """Objects that appear to float, as an approaching car does: nearer than it is, and smaller.

    Args:
        inverse: inverse depth, 0 or less where there is none. [h, w]
        ground: inverse depth of the ground, 0 near the horizon and above. [h, w]
    """
    result = np.zeros(inverse.shape, bool)
    inverse = np.asarray(cv2.medianBlur(np.maximum(inverse, 0), 5), np.float32)
    kernel = np.ones((3, 3), np.uint8)
    smallest = cv2.erode(np.where(inverse > 0, inverse, FAR).astype(np.float32), kernel)
    whole = (inverse > 0) & (cv2.dilate(inverse, kernel) < EDGE * smallest)  # objects end where depth jumps
    on_ground = np.abs(inverse - ground) < ON_GROUND * ground
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(((inverse > FLOATS * ground) & whole).astype(np.uint8))
    for label in np.flatnonzero(boxes[:, cv2.CC_STAT_AREA] >= PIECE)[1:]:
        left, top, width, height = boxes[label, :4]
        window = np.s_[top : top + height + GAP, left : left + width]
        part = labels[window] == label
        last = len(part) - 1 - part[::-1].argmax(0)
        columns = np.arange(part.shape[1])
        visible = whole[window] & (np.arange(len(part))[:, None] > last)
        first = visible.argmax(0)
        bare = visible.any(0) & on_ground[window][first, columns] & (ground[window][last, columns] > 0)
        if bare[part.any(0)].mean() > BARE:
            result[window] |= part
    return result
