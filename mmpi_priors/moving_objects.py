"""Whole objects from scattered evidence of motion: seeds, growth along edges, tracking from image to image.

Conservative: a seed is an area, not a line, that matches at no depth at which two neighbours agree, and that two
neighbours would see at any depth.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mmpi_priors.dense import correlation, mean_and_contrast
from mmpi_priors.moving_evidence import (
    ALL,
    SOLID,
    Evidence,
    Mask,
    Neighbour,
    Shot,
    Warp,
    all_where,
    most_of_channels,
    turned,
    two_least,
)
from mmpi_priors.views import look_up, pixel_grid

LEAST_LEVELS, NOISES = 12.0, 4.0
"""Threshold of strong evidence for a seed: gray levels, plus this multiple of the image's noise."""
WEAKER = 1.3
"""Factor on the threshold for weak evidence."""
STEPS, PARTS, REACH = 48, 4, 1.2
"""Number of inverse depths at which seeds are compared with the neighbours, up to this multiple of the nearest
content's."""
UNASKED = -1
"""Value of a pixel that was no candidate so far."""
DENSITY, AROUND = 0.35, 7
"""Minimum share of seeds in a window of this many pixels around a seed."""
LEAST_PIXELS, LEAST_SIDE = 15, 4
"""Minimum number of seeds of an object, and minimum shorter side of their extent, pixels at working size."""
TOGETHER = 15
"""Maximum gap between seeds of one object, pixels."""
TALL = 1.15
"""Maximum height of an object relative to the camera's."""
NARROW, UPRIGHT, LOW = 0.4, 1.05, 0.8
"""Width relative to the camera's height below which an object is a person, with a height up to the second and a head of
other colours than its body; other objects are filled up to the third."""
SHADED = 0.8
"""The same for a person with a shadow on the ground, which is filled only between the columns of its upper seeds."""
CORE = 0.1
"""Minimum share of an object covered by seeds, half of it where no neighbour sees the background: other objects are
strips of static surfaces."""
UNSEEN, GAP, LOWEST = 0.5, 3, 0.24
"""Minimum share of undecidable pixels beside or below an object for it to extend there; the gap between is at most its
width over twice the second; maximum ratio of the rows below it to those below the horizon for it to be cut off
there."""
CERTAIN = 10
"""Maximum evidence of a static pixel with a depth, gray levels."""
STANDS = 0.1
"""Minimum share of an object below the height of the camera: moving objects stand on the ground, and branches, chimneys
and towers in front of the sky look like moving ones where few images far apart see them."""
ITERATIONS, LARGE = 3, 4000
"""Iterations of GrabCut, and number of pixels above which it runs at half the size."""
FOLLOWED, INNER = 0.7, 3
"""Minimum correlation with the neighbour for an object to be tracked, and erosion of its uncertain outline where the
camera did not turn, pixels."""


def seeds(shot: Shot, others: Sequence[Neighbour], evidence: Evidence, levels: NDArray[np.int16]) -> Mask:
    """Pixels that certainly move. [h, w]

    ``levels`` caches the results of ``unexplained``, UNASKED where it was not called, and is updated. [h, w]
    """
    least = LEAST_LEVELS + NOISES * evidence.noise
    candidates = (evidence.strong > least) | (evidence.weak > WEAKER * least)
    unasked = candidates & (levels == UNASKED)
    levels[unasked] = unexplained(shot, others, unasked)
    result = candidates & (levels > least)
    share = cv2.boxFilter(result.astype(np.float32), -1, (AROUND, AROUND))
    return result & (share > DENSITY)


def unexplained(shot: Shot, others: Sequence[Neighbour], candidates: Mask) -> NDArray[np.uint8]:
    """Minimum over depths of the difference of some pixels from all neighbours but one; where it is below the threshold
    of a seed, that at some depth. [P]

    0 where two neighbours see nothing at one of the depths: undecidable.
    """
    rows, columns = np.nonzero(candidates)
    measured = shot.depth.inverse[shot.depth.inverse > 0]
    if not len(rows) or not len(measured):
        return np.zeros(len(rows), np.uint8)
    steps = np.linspace(0, REACH * np.percentile(measured, 98), STEPS, dtype=np.float32)[:, None]
    kernel, layers = np.ones((3, 3), np.uint8), [other.with_still(None) for other in others]
    ranges = [(cv2.erode(layer, kernel), cv2.dilate(layer, kernel)) for layer in layers]
    levels, left = np.full(len(rows), ALL, np.uint8), np.arange(len(rows))
    for part in range(PARTS):
        at = rows[left], columns[left]
        inverse = np.repeat(steps[part::PARTS], len(left), 1)
        if shot.ground is not None:
            inverse = np.maximum(inverse, SOLID * shot.ground[at])
        color = np.repeat(cv2.cvtColor(shot.color[at][None], cv2.COLOR_BGR2BGRA), len(inverse), 0)
        distances = []
        for other, (low, high) in zip(others, ranges, strict=True):
            x, y, ahead = other.warp.at(at, len(inverse)).places(inverse)
            low, high = (look_up(image, x + 0.5, y + 0.5, nearest=True) for image in (low, high))
            apart = most_of_channels(cv2.max(cv2.subtract(low, color), cv2.subtract(color, high)))
            visible = (cv2.extractChannel(high, 3) > 0) & (ahead > 0)
            distances.append(np.minimum(apart, np.uint8(ALL - 1)) | all_where(~visible))
        _, second = two_least(distances)
        levels[left] = np.minimum(levels[left], np.where((second < ALL).all(0), second.min(0), 0))
        left = left[levels[left] > LEAST_LEVELS]
        if not len(left):
            break
    return levels


def is_static(shot: Shot, evidence: Evidence) -> Mask:
    """Pixels with a possible depth that nothing contradicts. [h, w]"""
    static = (shot.depth.inverse > 0) & (evidence.behind < CERTAIN) & (evidence.weak < CERTAIN)
    return static if shot.ground is None else static & (shot.depth.inverse > SOLID * shot.ground)


def grown(shot: Shot, evidence: Evidence, core: Mask) -> Mask:
    """Objects around seeds, by GrabCut in a box. [h, w]"""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (TOGETHER, TOGETHER))
    number, labels = cv2.connectedComponents(cv2.dilate(core.astype(np.uint8), kernel))
    static = is_static(shot, evidence)
    result = np.zeros_like(core)
    for label in range(1, number):
        part = core & (labels == label)
        rows, columns = np.nonzero(part)
        if len(rows) < LEAST_PIXELS or min(np.ptp(rows), np.ptp(columns)) < LEAST_SIDE:
            continue
        room, body = room_of(shot, evidence.judged, part)
        whole = _object(shot, part, evidence.judged, static, room, body)
        if shot.level is None or (whole & (np.arange(len(part))[:, None] > shot.level)).sum() > STANDS * whole.sum():
            result |= whole
    return result


def room_of(shot: Shot, judged: Mask, part: Mask) -> tuple[tuple[int, int, int, int], int]:
    """Left, top, right and bottom of the box of the object of some seeds, and the row at which its body starts.

    Seeds lie only where neighbours see the background. Next to the border of an image few do, so an object may extend
    to undecidable pixels.
    """
    (height, width), (rows, columns) = part.shape, np.nonzero(part)
    left, right, top, bottom = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
    horizon = height if shot.horizon is None else float(shot.horizon[left:right].mean())
    near = np.ones((1, 2 * ((right - left) // GAP // 2) + 1), np.uint8)
    seen = cv2.dilate((judged[top:bottom].mean(0) < 1 - UNSEEN).astype(np.uint8)[None], near)[0] == 0
    aside = max(3, round(0.12 * (right - left)))
    room_left = left - aside if seen[:left].any() else 0
    room_right = right + aside if seen[right:].any() else width
    below = judged[bottom + 2 :, left:right]
    if height - bottom < LOWEST * (height - horizon) and below.size and below.mean() < 1 - UNSEEN:
        bottom = height
    highest, body = top - 0.3 * (bottom - top), top
    if shot.horizon is not None and bottom > horizon:  # it stands on the ground
        highest = min(top - 0.1 * (bottom - top), bottom - TALL * (bottom - horizon))
        tall = UPRIGHT if right - left < NARROW * (bottom - horizon) else LOW
        body = min(top, round(bottom - tall * (bottom - horizon)))
    return (int(room_left), int(highest), int(room_right), int(bottom) + 2), int(body)


def _object(shot: Shot, part: Mask, judged: Mask, static: Mask, room: tuple[int, int, int, int], body: int) -> Mask:
    """The object that covers some pixels certainly and others in its box possibly, by GrabCut, with its body."""
    height, (left, top, right, bottom) = len(part), room
    margin = max(8, round(0.3 * max(right - left, bottom - max(0, top))))
    inside = np.s_[max(0, top - margin) : bottom + margin, max(0, left - margin) : right + margin]
    perhaps = np.zeros_like(part)
    perhaps[max(0, top) : bottom, max(0, left) : right] = True
    perhaps &= ~static
    (rows, columns), shrink = part[inside].shape, 2 if part[inside].size > LARGE else 1
    images = shot.color[inside], part[inside].astype(np.uint8) * ALL, perhaps[inside].astype(np.uint8) * ALL
    color, surely, maybe = (
        cv2.resize(image, (columns // shrink, rows // shrink), interpolation=cv2.INTER_AREA) for image in images
    )
    labels = np.where(surely > 0, cv2.GC_FGD, np.where(maybe > ALL // 2, cv2.GC_PR_FGD, cv2.GC_BGD)).astype(np.uint8)
    if (labels == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(color, labels, None, *models, ITERATIONS, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    cut = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.float32)
    result = part.copy()
    result[inside] |= perhaps[inside] & (cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_LINEAR) > 0.5)
    # The colours of an object may be those around it; what stands in the columns above its seeds is its body.
    columns_of, last_row = part.any(0), int(np.flatnonzero(part.any(1))[-1])
    upper = np.flatnonzero(part[: (body + last_row) // 2].any(0))
    if shot.horizon is not None and len(upper) >= LEAST_SIDE:
        below = last_row - float(shot.horizon[columns_of].mean())
        if np.ptp(np.flatnonzero(columns_of)) < SHADED * below:  # pixels beside the feet are a shadow
            columns_of[: upper[0]] = columns_of[upper[-1] + 1 :] = False
    first, last = part.argmax(0), height - 1 - part[::-1].argmax(0)
    y = np.arange(height)[:, None]
    result |= columns_of & (y >= np.minimum(first, body)) & (y <= last) & ~static
    closed = cv2.morphologyEx(result.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    whole = filled(touching(closed > 0, part))
    return whole if part.sum() > CORE * (whole.sum() + (whole & judged).sum()) / 2 else np.zeros_like(whole)


def touching(mask: Mask, seeds: Mask) -> Mask:
    """Connected parts of a mask that contain seeds. [h, w]"""
    number, labels = cv2.connectedComponents(mask.astype(np.uint8))
    kept = np.bincount(labels.ravel(), seeds.ravel(), number) > 0
    kept[0] = False
    return kept[np.asarray(labels, np.int64)]


def filled(mask: Mask) -> Mask:
    """A mask with its holes filled. [h, w]"""
    outside = ~np.pad(mask, 1)
    _, labels = cv2.connectedComponents(outside.astype(np.uint8), connectivity=4)
    return (labels != labels[0, 0])[1:-1, 1:-1]


def followed(shot: Shot, other: Shot, mask: Mask, flow: cv2.DISOpticalFlow) -> Mask:
    """Moving objects of another shot, tracked into a shot by optical flow there and back. [h, w]

    Both are rotated to the same direction first: optical flow handles small displacements, and rotations shift all
    pixels.
    """
    gray = shot.view.gray
    x, y, ahead = Warp.between(shot.view, other.view).places(np.zeros(gray.shape, np.float32))
    inner = mask.astype(np.uint8)
    if not turned(shot.view, other.view):
        inner = cv2.erode(inner, np.ones((INNER, INNER), np.uint8))
    is_moving = cv2.remap(inner, x, y, cv2.INTER_NEAREST) * (ahead > 0)
    seen = np.asarray(cv2.remap(other.view.gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    there = np.asarray(flow.calc(gray, seen, None))  # type: ignore[call-overload]
    back = np.asarray(flow.calc(seen, gray, None))  # type: ignore[call-overload]
    x, y = pixel_grid(gray.shape)
    at = x + there[..., 0], y + there[..., 1]
    returned = np.abs(there + look_up(back, *at)).max(-1) < 1.5
    alike = correlation(gray, look_up(seen, *at), mean_and_contrast(gray))
    return returned & (alike > FOLLOWED) & (look_up(is_moving, *at, nearest=True) > 0)
