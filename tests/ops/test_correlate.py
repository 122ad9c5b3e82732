"""Correlation of windows of two images at an inverse depth, against single pixels in float64 (ops/correlate)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.correlate import Compared, correlate_at


@pytest.fixture(params=["torch", "native"], autouse=True)
def form(request):
    with dispatch.chosen(request.param):
        yield


def warped(shape, other, linear, b, inverse):
    """Oracle: gray levels of another image at the pixels of an image of this shape, in 32nds of pixels."""
    seen, wide = np.zeros(shape, int), np.pad(other.astype(int), 1)
    for row, column in np.ndindex(*shape):
        right, down, ahead = linear @ [column + 0.5, row + 0.5, 1] + inverse * b
        if ahead <= 1e-6:
            continue
        x, y = (int(np.rint(32 * (c / ahead - 0.5))) for c in (right, down))
        (left, u), (top, v) = divmod(x, 32), divmod(y, 32)
        if not (-1 <= left < other.shape[1] and -1 <= top < other.shape[0]):
            continue
        four = wide[top + 1 : top + 3, left + 1 : left + 3]
        seen[row, column] = int(np.floor([32 - v, v] @ four @ [32 - u, u] / 1024 + 0.5))
    return seen


def windows(image):
    wide = np.pad(image.astype(float), 3, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(wide, (7, 7)).reshape(*image.shape, 49)


def expected(gray, seen):
    mine, theirs = windows(gray), windows(seen)
    spreads = [np.maximum(part.std(-1), 1) for part in (mine, theirs)]
    common = (mine * theirs).mean(-1) - mine.mean(-1) * theirs.mean(-1)
    return np.where(seen > 0, common / spreads[0] / spreads[1], -1)


def correlated(gray, others, linear, b, inverse):
    mine = windows(gray)
    of_view = (torch.from_numpy(np.float32(part)) for part in (mine.mean(-1), mine.std(-1)))
    parallax = [tuple(torch.from_numpy(np.float32(x)) for x in each) for each in zip(linear, b, strict=True)]
    compared = Compared.of([torch.from_numpy(x) for x in others], parallax)
    return correlate_at(torch.from_numpy(gray), *of_view, compared, inverse).numpy()


def parallax(count, seed):
    random = np.random.default_rng(seed)
    linear = np.eye(3) + random.normal(size=(count, 3, 3)) * [[0.02, 0.02, 1], [0.02, 0.02, 1], [1e-4, 1e-4, 0.02]]
    return np.float32(linear).astype(float), np.float32(random.normal(size=(count, 3)) * [5, 2, 0.3]).astype(float)


def content(kind, shape, seed):
    random = np.random.default_rng(seed)
    if kind == "flat":
        return np.full(shape, 200, np.uint8)
    if kind == "black and white":
        return (255 * random.integers(0, 2, shape)).astype(np.uint8)
    return random.integers(0 if kind == "holes" else 1, 5 if kind == "holes" else 256, shape).astype(np.uint8)


@pytest.mark.parametrize("kind", ["noise", "flat", "black and white", "holes"])
@pytest.mark.parametrize(("shape", "inverse"), [((21, 37), 0.0), ((9, 16), 0.8), ((12, 19), -2.5), ((1, 1), 0.3)])
def test_correlations_are_those_of_single_pixels(kind, shape, inverse):
    gray, shapes = content(kind, shape, 0), [shape, (shape[0] + 3, shape[1] + 8), (2, 3)]
    others = [content(kind, each, n) for n, each in enumerate(shapes)]
    linear, b = parallax(3, 4)
    result = correlated(gray, others, linear, b, inverse)
    for n, other in enumerate(others):
        seen = warped(shape, other, linear[n], b[n], inverse)
        # A place between two 32nds may fall to either, and changes the windows that it is in by a level or so.
        assert np.abs(result[n] - expected(gray, seen)).max() < (0.02 if kind != "holes" else 0.4)
        assert (np.abs(result[n] - expected(gray, seen)) > 2e-3).mean() < 0.05


def test_nothing_is_alike_behind_the_other_camera_or_far_outside():
    gray = content("noise", (15, 20), 0)
    for shift in ([0, 0, -3.0], [1e9, 0, 0], [0, -1e30, 0]):
        assert (correlated(gray, [gray], [np.eye(3)], [np.array(shift)], 1.0) == -1).all()
    same = correlated(gray, [gray], [np.eye(3)], [np.zeros(3)], 1.0)
    assert same == pytest.approx(1, abs=1e-4)
