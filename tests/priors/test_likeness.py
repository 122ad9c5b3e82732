"""Correlations with other images at inverse depths, against single pixels in float64 (ops/likeness)."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
import torch

from mmpi_priors.ops.likeness import most_alike
from mmpi_priors.ops.patches import others_of

SHAPE, SHAPES = (13, 21), [(13, 21), (9, 30), (16, 8), (13, 21)]
CLOSE = 0.01
"""Places and gray levels are rounded, single precision may round the other way."""
pytestmark = pytest.mark.usefixtures("form")


def texture(rng, shape):
    image = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 1.2)
    return (128 + 90 * image / np.abs(image).max()).astype(np.uint8)


def a_scene(count, seed, ahead=0.5):
    """An image, others with marks, and their linear parts and shifts as the operation reads them."""
    rng = np.random.default_rng(seed)
    gray, shapes = texture(rng, SHAPE), SHAPES[:count]
    gray[:8, 12:] = 90  # without texture
    grays = [texture(rng, shape) for shape in shapes]
    for image in grays:
        image[2:4, 5:] = 0  # nothing
        image[-8:, :9] = 200
    marks = [(rng.random(shape) < 0.3).astype(np.uint8) for shape in shapes]
    linear, b = [], []
    for height, width in shapes:
        turn = cv2.Rodrigues(0.05 * rng.normal(size=3))[0]
        here, there = (np.array([[20, 0, w / 2], [0, 20, h / 2], [0, 0, 1]]) for h, w in (SHAPE, (height, width)))
        linear.append(there @ turn @ np.linalg.inv(here))
        b.append(there @ (rng.normal(size=3) * [0.3, 0.2, ahead]))
    return gray, grays, marks, np.float32(linear).reshape(-1, 3, 3), np.float32(b).reshape(-1, 3)


def operands(grays, marks, linear, b):
    images = [[torch.from_numpy(np.pad(x, 1)) for x in both] for both in zip(grays, marks, strict=True)]
    return others_of(images, torch.from_numpy(linear), torch.from_numpy(b))


class Oracle:
    """One other image at one inverse depth."""

    def __init__(self, gray, other, marks, linear, b, q):
        self.gray = gray.astype(float)
        self.seen, self.marked = np.zeros(gray.shape), np.zeros(gray.shape)
        self.undecided, self.behind_or_not = np.zeros((2, *gray.shape), bool)
        for r, c in np.ndindex(gray.shape):
            x, y, z = linear.astype(float) @ [c + 0.5, r + 0.5, 1] + float(q) * b.astype(float)
            self.behind_or_not[r, c] = abs(z) < 1e-3
            if z > 0:
                column, row = x / z - 0.5, y / z - 0.5
                self.seen[r, c] = np.floor(
                    self.between(other, np.round(32 * row) / 32, np.round(32 * column) / 32) + 0.5
                )
                nearest = round(row), round(column)
                inside = all(0 <= at < n for at, n in zip(nearest, other.shape, strict=True))
                self.marked[r, c] = marks[nearest] if inside else 0
                self.undecided[r, c] = 0 < self.seen[r, c] < 2 or any(abs(n % 1 - 0.5) < 1e-3 for n in (row, column))

    @staticmethod
    def between(other, row, column):
        near = [np.maximum(1 - np.abs(np.arange(n) - at), 0) for n, at in zip(other.shape, (row, column), strict=True)]
        return near[0] @ other.astype(float) @ near[1]

    def correlation(self, r, c):
        """-1 where nothing is seen, NaN where it is undecided."""
        if self.undecided[r, c]:
            return np.nan
        if self.seen[r, c] == 0:
            return -1.0
        rows, columns = (
            np.arange(at - 3, at + 4).clip(0, n - 1) for at, n in zip((r, c), self.gray.shape, strict=True)
        )
        mine, theirs = (image[rows[:, None], columns] for image in (self.gray, self.seen))
        if self.behind_or_not[rows[:, None], columns].any():
            return np.nan
        covariance = ((mine - mine.mean()) * (theirs - theirs.mean())).mean()
        return covariance / max(mine.std(), 1) / max(theirs.std(), 1)


@cache
def correlations(count, seed, ahead, q):
    """Of each other image at an inverse depth, pixel by pixel, and the images' marks there. [N, H, W] each"""
    gray, *others = a_scene(count, seed, ahead)
    oracles = [Oracle(gray, *other, q) for other in zip(*others, strict=True)]
    each = [[oracle.correlation(r, c) for r, c in np.ndindex(SHAPE)] for oracle in oracles]
    return np.reshape(each, (count, *SHAPE)), np.array([oracle.marked for oracle in oracles])


def expected(correlations, marks, q, least, most, pairs):
    """Correlations of the three kinds at an inverse depth, -1 where it is of another kind, NaN: undecided. [3, H, W]"""
    result = np.full((3, *SHAPE), -1.0)
    for r, c in np.ndindex(SHAPE):
        each = correlations[:, r, c].tolist()
        kind = 0 if least[r, c] <= q <= most else 1
        if np.isnan(each).any():
            result[:, r, c] = np.nan
        elif pairs:
            result[kind, r, c] = np.mean(sorted([-1, -1, *each])[-2:])
        else:
            for marked, one in zip(marks[:, r, c], each, strict=True):
                its = 2 if marked else kind
                result[its, r, c] = max(result[its, r, c], one)
    return result


def asked(scene, depths, least, most, pairs):
    gray, *others = scene
    values = most_alike(
        torch.from_numpy(gray), operands(*others), torch.from_numpy(depths), torch.from_numpy(least), most, pairs
    )
    return values.alike.numpy(), values.inverse.numpy()


@pytest.mark.parametrize("pairs", [False, True])
@pytest.mark.parametrize(("count", "seed", "ahead"), [(1, 0, 0.5), (2, 1, 0.5), (4, 2, 0.5), (3, 3, 4.0)])
def test_the_most_alike_depths_are_those_of_single_pixels(count, seed, ahead, pairs):
    """Some lie in part behind the other camera (with a shift of 4), beside the image or where it shows nothing."""
    scene = a_scene(count, seed, ahead)
    depths = np.linspace(-0.4, 0.9, 6, dtype=np.float32)
    least = np.random.default_rng(seed).uniform(-0.3, 0.5, SHAPE).astype(np.float32)
    alone = [asked(scene, depths[d : d + 1], least, 0.8, pairs)[0] for d in range(len(depths))]
    kinds = np.zeros(3)
    for q, alike in zip(depths, alone, strict=True):
        truth = expected(*correlations(count, seed, ahead, q), q, least, 0.8, pairs)
        decided = ~np.isnan(truth)
        assert decided.mean() > 0.6
        assert alike[decided] == pytest.approx(truth[decided], abs=CLOSE)
        kinds += (alike > -1).mean((1, 2))
    assert min(kinds[:2]) > 0.5 and (kinds[2] == 0 if pairs else kinds[2] > 0.5)
    alike, inverse = asked(scene, depths, least, 0.8, pairs)
    assert (alike == np.max(alone, 0)).all()
    assert (inverse == np.where(alike > -1, depths[np.argmax(alone, 0)], 0)).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38, -1e38])
def test_inverse_depths_that_are_none_show_nothing_or_are_numbers(value):
    scene = a_scene(2, 5)
    alike, _ = asked(scene, np.float32([value]), np.zeros(SHAPE, np.float32), 1.0, False)
    assert np.isfinite(alike).all() and (np.isfinite(value) or (alike == -1).all())
