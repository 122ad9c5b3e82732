"""Differences of colours at given depths, against single pixels in float64 (ops/unlike)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.unlike import Layers, compare_colors


@pytest.fixture(params=["torch", "native"], autouse=True)
def form(request):
    with dispatch.chosen(request.param):
        yield


def around(image, row, column, reach, mirror):
    """Values about a pixel: of those that are there, or mirrored about the border."""
    places = []
    for at, size in ((row, image.shape[0]), (column, image.shape[1])):
        every = np.arange(at - reach, at + reach + 1)
        last = size - 1
        inside = np.minimum(np.abs(last - np.abs(last - np.abs(every))), last) if mirror else every
        places.append(inside[(inside >= 0) & (inside < size)])
    return image[np.ix_(*places)]


def oracle(color, inverse, colors, depths, linear, b):
    """Levels of each other image, and what pairs of them say; where a place is between two pixels it is undecided."""
    shape, levels, frees, seens = color.shape[:2], [], [], []
    decided = np.ones(shape, bool)
    for layer, depth, m, shift in zip(colors, depths, linear, b, strict=True):
        seen, free = np.zeros((*shape, 4), int), np.zeros(shape, bool)
        shown = np.zeros(shape, bool)
        for r, c in np.ndindex(*shape):
            right, down, ahead = m @ [c + 0.5, r + 0.5, 1] + inverse[r, c] * shift
            if ahead <= 1e-6:
                seen[r, c] = layer[0, 0]
                continue
            x, y = (np.clip(v / ahead - 0.5, 0, n - 1) for v, n in zip((right, down), layer.shape[1::-1], strict=True))
            decided[r, c] &= min(abs(x % 1 - 0.5), abs(y % 1 - 0.5)) > 1e-4
            at = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
            seen[r, c], shown[r, c] = layer[at], layer[at][3] > 0
            expected = inverse[r, c] / ahead
            free[r, c] = shown[r, c] and expected / 1.15 <= depth[at] <= 1.15 * expected
        apart = np.zeros(shape)
        for r, c in np.ndindex(*shape):
            window = around(seen[..., :3], r, c, 1, mirror=False).reshape(-1, 3)
            outside = np.maximum(window.min(0) - color[r, c, :3], color[r, c, :3].astype(int) - window.max(0))
            apart[r, c] = min(80, max(0, outside.max()))
        means = np.array(
            [[around(apart, r, c, 2, mirror=True).mean() for c in range(shape[1])] for r in range(shape[0])]
        )
        levels.append(np.where(shown, np.rint(means), 255).astype(int))
        frees.append(free)
        seens.append(seen[..., :3])
    pair, agreed = np.zeros(shape, int), np.zeros(shape, bool)
    for a in range(len(colors)):
        for other in range(max(0, a - 2), a):
            agrees = frees[a] & frees[other] & (np.abs(seens[a] - seens[other]).max(-1) < 12)
            agreed |= agrees
            pair = np.where(agrees, np.maximum(pair, np.minimum(levels[a], levels[other])), pair)
    return np.array(levels), pair, agreed, decided


def capture(shape, kind, count=4):
    """An image, inverse depths, and others of other sizes that show nothing at their borders."""
    random = np.random.default_rng(7)
    base = random.integers(0, 256, 3) if kind == "one colour" else random.integers(0, 256, (*shape, 3))
    spread = 5 if kind == "alike" else 0
    colors, depths = [], []
    for n in range(count):
        size = (shape[0] + n % 2, shape[1] + 2 * (n % 3))
        layer = np.zeros((*size, 4), np.uint8)
        layer[..., :3] = (
            random.integers(0, 256, (*size, 3)) if kind == "noise" else 100 + random.integers(0, 9, (*size, 3))
        )
        layer[1:-1, 1:-1, 3] = np.where(random.uniform(size=(size[0] - 2, size[1] - 2)) < 0.9, 255, 0)
        colors.append(layer)
        depths.append(np.float32(np.where(random.uniform(size=size) < 0.8, random.uniform(0.4, 0.6, size), 0)))
    color = np.zeros((*shape, 4), np.uint8)
    color[..., :3] = 103 + random.integers(-spread, spread + 1, (*shape, 3)) if kind == "alike" else base
    inverse = np.float32(random.uniform(0.4, 0.6, shape))
    inverse[:, 0] = 0
    if kind == "noise":
        inverse[-1] = 30  # behind another camera
    linear = np.eye(3) + random.normal(size=(count, 3, 3)) * [[0.02, 0.02, 1], [0.02, 0.02, 1], [1e-4, 1e-4, 0.02]]
    b = random.normal(size=(count, 3)) * [3, 1, 0.1]
    b[-1, 2] = -0.1
    return color, inverse, colors, depths, np.float32(linear).astype(float), np.float32(b).astype(float)


@pytest.mark.parametrize("kind", ["noise", "alike", "one colour"])
@pytest.mark.parametrize("shape", [(13, 21), (3, 40), (6, 5)])
def test_differences_are_those_of_single_pixels(kind, shape):
    color, inverse, colors, depths, linear, b = capture(shape, kind)
    parallax = [tuple(torch.from_numpy(np.float32(x)) for x in each) for each in zip(linear, b, strict=True)]
    layers = Layers.of([torch.from_numpy(x) for x in colors], [torch.from_numpy(x) for x in depths], parallax)
    packed = torch.from_numpy(color).view(torch.int32)[..., 0]
    levels, pair, agreed, decided = oracle(color, inverse, colors, depths, linear, b)
    result = compare_colors(packed, torch.from_numpy(inverse), layers, True)
    # A place between two pixels changes the windows that it is in.
    near = np.array([[around(decided, r, c, 3, mirror=True).all() for c in range(shape[1])] for r in range(shape[0])])
    assert near.mean() > 0.5
    assert (np.abs(result.levels.numpy().astype(int) - levels) <= 1)[:, near].all()
    assert (result.levels.numpy() != levels)[:, near].mean() < 0.01
    assert (np.abs(result.pair.numpy().astype(int) - pair) <= 1)[near].all()
    assert (result.agreed.numpy() == agreed)[near].all()
    assert kind != "alike" or min(shape) < 10 or agreed.mean() > 0.1
    alone = compare_colors(packed, torch.from_numpy(inverse), layers, False)
    assert (alone.levels == result.levels).all() and not alone.pair.any() and not alone.agreed.any()
