"""People in an image: what OpenCV's detector proposes, where it stands on the ground as tall as people are.

Sources: N. Dalal and B. Triggs, Histograms of Oriented Gradients for Human Detection, CVPR 2005 (``cv2.HOGDescriptor``
with the default detector, which ships with OpenCV). Above a level ground every point at the height of the camera lies
on the horizon, so that the feet of a person lie below it by the height of the camera over that of the person, times the
height in the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from mmpi_ns.data.checks import say_once
from mmpi_priors.tracks import PosedImages
from mmpi_priors.views import View, load_view

SIDE, ENLARGED = 2048, 2.0
"""Longer side of the image in which people are searched, pixels, and its size over that of the original, at most: the
detector finds people from 96 pixels in height."""
ABOVE, BELOW = 0.12, 0.3
"""Rows that are searched, from above the horizon to below it, in widths of the image."""
LEVELS, FINER, CELL = 40, 1.1, 8
"""Sizes that are searched at most, their ratio, and pixels from one window of the detector to the next."""
TALL, SPARE = 96, 24
"""Pixels of a person in the detector's window, and beyond those that are searched above and below."""
ALIKE = 0.2
"""Share of their size by which windows of the detector that show the same person differ, at most."""
HEIGHTS = (0.6, 1.3)
"""Height of the camera over that of a person."""
MARGIN = np.array([1 / 8, 1 / 8])
"""Around the person in the detector's window, at each side, as a share of its width and height."""


@dataclass(frozen=True)
class People:
    """What looks like people in an image."""

    boxes: Int[ndarray, "N 4"]
    """Left, top, right and bottom, in pixels of its view at working size."""
    scores: Float[ndarray, "N"]
    """Of the detector, the best of windows that show the same; above 0."""


NOBODY = People(np.zeros((0, 4), int), np.zeros(0))


def has_detector() -> bool:
    """Whether OpenCV has its detector of people, which left it with version 5; if not, says so once."""
    if hasattr(cv2, "HOGDescriptor"):
        return True
    say_once(
        f"People are not looked for, only what moves otherwise: OpenCV {cv2.__version__} has no detector (pip install "
        "'opencv-python-headless<5' brings it back)."
    )
    return False


def horizon_of(view: View, up: Float[ndarray, "3"]) -> Float[ndarray, "w"] | None:
    """Row of the horizon in each column of a view; None where it looks steeply up or down."""
    fx, fy, cx, cy = view.pinhole
    right, down, ahead = np.array([1, -1, -1]) * (view.pose[:, :3].T @ up)
    if abs(down) < 0.5:
        return None
    x = (np.arange(view.gray.shape[1]) + 0.5 - cx) / fx
    return cy - fy * (right * x + ahead) / down


def people_in(images: PosedImages, i: int, view: View, up: Float[ndarray, "3"]) -> People:
    """What looks like people in an image, stands on the ground and is as tall as people are.

    Args:
        images: the originals.
        i: the image.
        view: the same at working size.
        up: unit vector in the world.
    """
    horizon = horizon_of(view, up)
    if horizon is None or not has_detector():
        return NOBODY
    wide = load_view(images, i, SIDE)
    height, width = wide.gray.shape
    scale = min(ENLARGED, SIDE / max(height, width))
    level = float(horizon.mean()) * height / view.gray.shape[0]
    first, last = (int(np.clip(level + share * width, 0, height)) for share in (-ABOVE, BELOW))
    if last <= first:
        return NOBODY
    gray = cv2.resize(wide.gray[first:last], None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    ends = scale * (horizon[[0, -1]] * height / view.gray.shape[0] - first)  # of the horizon, in these rows
    detector = cv2.HOGDescriptor()
    detector.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector(), np.float32))
    size, placed, scores = detector.winSize, [np.zeros((0, 4))], [np.zeros(0)]
    for power in range(LEVELS):  # of each size only the rows that people have in whose height the camera stands
        shrink = FINER**power
        shape = round(gray.shape[1] / shrink), round(gray.shape[0] / shrink)
        if shape[0] < size[0] or shape[1] < size[1]:
            break
        top = max(0, round(ends.min() / shrink - (1 - HEIGHTS[0]) * TALL - SPARE) // CELL * CELL)
        bottom = max(0, round(ends.max() / shrink + HEIGHTS[1] * TALL + SPARE))
        part = cv2.resize(gray, shape, interpolation=cv2.INTER_LINEAR_EXACT)[top:bottom]
        corners, of_level = detector.detect(part, winStride=(CELL, CELL)) if len(part) >= size[1] else ((), ())
        if len(corners):
            boxes = np.insert(np.asarray(corners), [2, 2], size, 1)
            placed.append(np.round((boxes + np.array([0, top, 0, 0])) * shrink))
            scores.append(np.ravel(of_level))
    every, score = np.concatenate(placed).astype(int), np.concatenate(scores)
    grouped = np.reshape(cv2.groupRectangles(every.tolist(), 1, ALIKE)[0], (-1, 4)).astype(np.float64)
    alike = np.abs(every - grouped[:, None]).max(-1) <= ALIKE * grouped[:, 2:].mean(-1)[:, None]
    best = np.where(alike, score, 0).max(-1, initial=0)
    low, extent = grouped[:, :2] + MARGIN * grouped[:, 2:], (1 - 2 * MARGIN) * grouped[:, 2:]
    boxes = (np.concatenate([low, low + extent], -1) / scale + [0, first, 0, first]) * view.gray.shape[0] / height
    camera = (boxes[:, 3] - np.interp(boxes[:, [0, 2]].mean(1), np.arange(len(horizon)) + 0.5, horizon)) / (
        boxes[:, 3] - boxes[:, 1]
    )
    standing = (camera > HEIGHTS[0]) & (camera < HEIGHTS[1])
    return People(boxes[standing].round().astype(int), best[standing])
