"""Motion of patches between two images, against single patches in float64 (ops/motion)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import correlate, map_coordinates

from mmpi_priors.ops.motion import find_motion, refine_motion

SIDE, FLAT = 8, 16
pytestmark = pytest.mark.usefixtures("form")


def look(image, x, y):
    return map_coordinates(image, [np.atleast_1d(y), np.atleast_1d(x)], order=1, mode="nearest")


class Oracle:
    """One patch at a time."""

    def __init__(self, gray, other, coarse, stride, rounds):
        self.gray, self.other, self.rounds = gray.astype(float), other.astype(float), rounds
        sobel = np.outer([1, 2, 1], [-1, 0, 1]) / 8
        self.slopes = [correlate(self.gray, kernel, mode="nearest") for kernel in (sobel, sobel.T)]
        (h, w), (a, b) = gray.shape, coarse.shape[:2]
        self.corners = {(i, j): (stride * i, stride * j) for i in range(1 + (h - SIDE) // stride)
                        for j in range(1 + (w - SIDE) // stride)}  # fmt: skip
        first = {}
        for key, (row, column) in self.corners.items():
            at = (column + 4.5) * b / w - 0.5, (row + 4.5) * a / h - 0.5
            start = np.concatenate(
                [look(coarse[..., n].astype(float), *at) * of for n, of in enumerate((w / b, h / a))]
            )
            first[key] = self.descend(row, column, start)
        self.totals = np.zeros((h, w, 3))
        for (i, j), (row, column) in self.corners.items():
            mine, least = first[i, j]
            best = mine
            for beside in ((i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j)):
                if beside in first and np.hypot(*(first[beside][0] - mine)) > 0.25:
                    error = self.error(row, column, first[beside][0])
                    if error < least:
                        best, least = first[beside][0], error
            if best is not mine:
                best, _ = self.descend(row, column, best)
            weight = 1 / np.maximum(1, np.abs(self.apart(row, column, best)))
            self.totals[row : row + SIDE, column : column + SIDE] += weight[..., None] * [*best, 1]
        bottom, right = max(self.corners.values())
        self.totals[bottom + SIDE :] = self.totals[bottom + SIDE - 1]
        self.totals[:, right + SIDE :] = self.totals[:, right + SIDE - 1 : right + SIDE]
        self.motion = self.totals[..., :2] / self.totals[..., 2:]

    def apart(self, row, column, motion):
        (h, w), (x, y) = self.gray.shape, np.meshgrid(np.arange(SIDE), np.arange(SIDE))
        x, y = np.clip(column + motion[0], 1 - SIDE, w - 1) + x, np.clip(row + motion[1], 1 - SIDE, h - 1) + y
        return look(self.other, x, y) - self.gray[row : row + SIDE, column : column + SIDE]

    def error(self, row, column, motion):
        apart = self.apart(row, column, motion)
        return ((apart - apart.mean()) ** 2).sum()

    def descend(self, row, column, start):
        slopes = np.stack([s[row : row + SIDE, column : column + SIDE].ravel() for s in self.slopes], -1)
        slopes = slopes - slopes.mean(0)
        at, best, least = start, start, np.inf
        for _ in range(self.rounds):
            error = self.error(row, column, at)
            if error >= least:
                break
            best, least = at, error
            step = np.linalg.solve(slopes.T @ slopes + FLAT * np.eye(2), slopes.T @ self.apart(row, column, at).ravel())
            at = at - step
            if np.hypot(*(at - start)) > 8:
                break
        return best, least


def image(seed, shape, blur=1.5):
    noise = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), blur) if blur else noise


def moved(gray, right, down):
    shift = np.float32([[1, 0.01, right], [-0.01, 1, down]])
    return cv2.warpAffine(gray, shift, gray.shape[::-1], borderMode=cv2.BORDER_REPLICATE)


def refined(gray, other, coarse, stride, rounds):
    arrays = (gray, other, np.float32(coarse))
    return refine_motion(*(torch.from_numpy(np.ascontiguousarray(x)) for x in arrays), stride, rounds).numpy()


@pytest.mark.parametrize(("shape", "stride", "rounds"), [((31, 44), 6, 6), ((40, 27), 5, 3), ((19, 33), 8, 1)])
def test_motion_is_that_of_single_patches(shape, stride, rounds):
    gray = image(0, shape)
    other, coarse = moved(gray, 1.3, -0.8), np.random.default_rng(1).normal(size=(7, 9, 2))
    expected = Oracle(gray, other, coarse, stride, rounds).motion
    assert np.abs(refined(gray, other, coarse, stride, rounds) - expected).max() < 1e-3
    assert np.abs(expected).max() > 1


@pytest.mark.parametrize("hard", ["flat", "noise", "edge", "far"])
def test_motion_of_hard_images_is_that_of_single_patches(hard):
    gray = {"flat": np.full((24, 30), 90, np.uint8), "edge": np.repeat([[10, 240]], 24, 0).repeat(15, 1)}.get(hard)
    gray = image(2, (24, 30), 0) if gray is None else gray.astype(np.uint8)
    other = image(3, (24, 30), 0) if hard == "noise" else moved(gray, 0.6, 0.4)
    coarse = np.full((1, 1, 2), 1e4 if hard == "far" else 0.0)
    result = refined(gray, other, coarse, 6, 4)
    assert np.isfinite(result).all()
    apart = np.abs(result - Oracle(gray, other, coarse, 6, 4).motion).max(-1)
    # Where nearly equal errors decide, float32 may decide otherwise.
    assert (apart > 1e-2 * max(1, coarse.max())).mean() < 0.05
    if hard == "flat":
        assert (result == 0).all()


@pytest.mark.parametrize("shape", [(8, 8), (8, 50), (61, 97), (120, 90)])
def test_a_moved_image_is_followed_from_coarse_to_fine(shape):
    gray = image(4, shape, 2)
    motion = find_motion(gray, moved(gray, 2.2, -1.6), 6, 6)
    assert motion.shape == (*shape, 2) and np.isfinite(motion).all()
    if min(shape) > 60:
        inner = motion[12:-12, 12:-12]
        x, y = np.meshgrid(np.arange(12, shape[1] - 12), np.arange(12, shape[0] - 12))
        true = np.stack([2.2 + 0.01 * y, -1.6 - 0.01 * x], -1)
        assert np.median(np.abs(inner - true)) < 0.05
