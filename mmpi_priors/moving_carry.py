"""Tracking of objects that move along the camera's path, into images where too few neighbours see the background.

A car that leaves or enters an image at the side is large there, moves across much of the image from one to the next,
and occludes what no other image sees. As it moves parallel to the path, it has one apparent inverse depth in all images
(``moving_sweep.py``). So the moving pixels of a neighbour are searched at inverse depths from behind the camera to
beyond the nearest content, by correlation at half the size. A match counts where its correlation clearly exceeds that
of all static content of the neighbours at possible depths. Paint has no texture, so matches are scattered over a car;
one that is not masked yet is filled as a whole.
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
"""Nearest neighbours from which objects are tracked, and whose static content is compared."""
BEHIND, BEYOND, DEPTHS = -0.5, 2.0, 72
"""Range of inverse depths as multiples of the nearest content's: approaching objects appear nearer than they are."""
GROUND, MARGIN, REACH = 0.9, 0.02, 1.2
"""Inverse depth of static content: at least the first multiple of the ground's less the second of the nearest
content's, at most the third of the nearest content's."""
BETTER = 0.1
"""Minimum difference of the correlations of moving and static content, each from one neighbour."""
COHERENT = 1.1
"""Steps by which an inverse depth may differ from the median around it."""
SCATTERED, CLOSED, LEAST_PIXELS = 3.0, 13, 450
"""The same within a whole object; gap across which its moving pixels are joined; minimum size of an object; at half the
size."""
NEW, UP = 0.5, 0.2
"""Maximum share of a new object that is already masked; maximum ratio of the distances below the horizon of its highest
and its lowest pixel: objects that pass the camera are nearly as high as it."""


@dataclass(frozen=True)
class Carried:
    """Inner part of the objects of the nearest neighbours in a shot. [h, w] each"""

    pixels: Mask
    objects: Mask
    """Whole objects that are not masked yet."""


def carried(shot: Shot, others: Sequence[Neighbour], masks: Sequence[Mask], mask: Mask) -> Carried:
    """Objects that move in the nearest neighbours of a shot (``masks`` in each, nearest first), at their positions in
    the shot; ``mask`` [h, w] has those of the shot so far."""
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
    stands, is_moving, inverse = alike[0].numpy(), alike[2].numpy(), at[2].numpy()
    if len(others) > AFTER:
        rest = best(slice(AFTER, STATIC), depths[(depths >= 0) & (depths <= most)])
        stands = np.maximum(stands, rest.alike[0].numpy())
    scatter = np.abs(inverse - cv2.medianBlur(inverse, 5)) / float(depths[1] - depths[0])
    textured = view.inside & (mean_and_contrast(view.gray)[1] > CONTRAST)
    is_moving = (is_moving > ALIKE) & (is_moving > stands + BETTER) & textured
    masked = cv2.resize(mask.astype(np.uint8), small, interpolation=cv2.INTER_NEAREST) > 0
    parts = (
        solid(is_moving & (scatter <= COHERENT), ground),
        whole_objects(is_moving & (scatter <= SCATTERED), ground, masked),
    )
    enlarged = (
        cv2.resize(part.astype(np.uint8), nothing.shape[::-1], interpolation=cv2.INTER_NEAREST) for part in parts
    )
    # Windows reach beyond the objects.
    return Carried(*(cv2.erode(part, np.ones((INSIDE, INSIDE), np.uint8)) > 0 for part in enlarged))


def whole_objects(is_moving: Mask, ground: Map, masked: Mask) -> Mask:
    """Large objects, not masked yet, with scattered moving pixels (paint has no texture). [h, w]

    Args:
        is_moving: pixels that move. [h, w]
        ground: inverse depth of the ground, 0 near the horizon and above. [h, w]
        masked: moving objects so far. [h, w]
    """
    around = np.pad(is_moving.astype(np.uint8), CLOSED)
    closed = cv2.morphologyEx(around, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CLOSED, CLOSED)))
    opened = cv2.morphologyEx(closed[CLOSED:-CLOSED, CLOSED:-CLOSED], cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(opened)
    horizon, result = np.count_nonzero((ground == 0).any(1)), np.zeros_like(is_moving)
    for label in range(1, number):
        part, (_, top, _, height, pixels) = labels == label, boxes[label]
        is_high = top - horizon <= UP * max(top + height - horizon, 0)
        if pixels >= LEAST_PIXELS and is_high and masked[part].mean() < NEW:
            result |= part
    return result
