"""Patches of planes and their spread, against single pixels in float64 (ops/patches)."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch

from mmpi_priors.ops.patches import Patches, compare_planes, others_of, spread_planes

HEIGHT, WIDTH, STRIDE, ALONE = 18, 37, 2, 0.1
PINHOLE = np.array([40.0, 44.0, 17.0, 8.0])
pytestmark = pytest.mark.usefixtures("form")


def texture(x, y):
    """A smooth pattern, gray levels."""
    return 120 + 50 * np.sin(0.7 * x + 0.2 * y) + 40 * np.cos(0.5 * y - 0.3 * x) + 20 * np.sin(0.31 * x * 1.7 + 1.1 * y)


def pinholes(count, seed, far=1.0):
    """Linear parts and shifts of homogeneous pixels between images, rounded as the operation reads them."""
    rng, linear, shifts = np.random.default_rng(seed), [], []
    matrix = np.array([[PINHOLE[0], 0, PINHOLE[2]], [0, PINHOLE[1], PINHOLE[3]], [0, 0, 1]])
    for _ in range(count):
        turn = np.linalg.qr(np.eye(3) + 0.03 * rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.diag(turn))
        linear.append(matrix @ turn @ np.linalg.inv(matrix))
        shifts.append(matrix @ (far * rng.normal(size=3) * [0.5, 0.3, 1.5]))
    return np.float32(linear).astype(float), np.float32(shifts).astype(float)


def random_scene(count, seed):
    """An image and others of any content, of several sizes."""
    rng = np.random.default_rng(seed)
    gray = rng.integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    gray[:7, :9] = 77  # without texture
    shapes = [[(2 * HEIGHT, 2 * WIDTH), (HEIGHT, WIDTH), (HEIGHT // 2, WIDTH // 2)] for _ in range(count)]
    grays = [[rng.integers(0, 256, shape, np.uint8) for shape in each] for each in shapes]
    grays[0][1][:, :12] = 50
    return gray, grays, *pinholes(count, seed)


def operands(gray, grays, linear, b):
    others = others_of([[torch.from_numpy(g) for g in each] for each in grays], *floats(linear, b))
    return torch.from_numpy(gray), others


def floats(*arrays):
    return [torch.from_numpy(np.asarray(x, np.float32)) for x in arrays]


def patch_of(gray, row, column):
    rows, columns = (
        (np.arange(-2, 3) * STRIDE + at).clip(0, n - 1) for at, n in zip((row, column), gray.shape, strict=True)
    )
    values = gray[rows[:, None], columns].astype(float)
    return values - values.mean()


def correlation(gray, row, column, plane, sizes, linear, b):
    """Oracle: the correlation with one image; None where it does not show the middle. NaN where it is undecided."""
    at = np.array([column + 0.5, row + 0.5])

    def homogeneous(x, y):
        q = plane[0] + plane[1] * (x - at[0]) + plane[2] * (y - at[1])
        return linear @ [x, y, 1] + q * b

    middle = homogeneous(*at)
    if abs(middle[2]) < 1e-3:
        return np.nan
    there, (height, width) = middle[:2] / middle[2], sizes[1].shape
    edge = min(*(there - 0.5), width - 0.5 - there[0], height - 0.5 - there[1])
    if middle[2] > 0 and abs(edge) < 1e-3:
        return np.nan
    if middle[2] < 0 or edge < 0:
        return None
    tiny = 1e-4
    moved = [homogeneous(at[0] + dx, at[1] + dy) for dx, dy in ((tiny, 0), (0, tiny))]
    area = abs(np.linalg.det([(m[:2] / m[2] - there) / tiny for m in moved]))
    if min(abs(area - 0.5), abs(area - 2)) < 1e-2:
        return np.nan
    image = sizes[0] if area < 0.5 else sizes[2] if area > 2 else sizes[1]
    values = np.empty((5, 5))
    for i, j in np.ndindex(5, 5):
        x, y, ahead = homogeneous(at[0] + (j - 2) * STRIDE, at[1] + (i - 2) * STRIDE)
        if abs(ahead - 0.2 * middle[2]) < 1e-3 * middle[2]:
            return np.nan
        if ahead < 0.2 * middle[2]:
            return -1.0
        place = np.array([y / ahead * image.shape[0] / height, x / ahead * image.shape[1] / width]) - 0.5
        place = place.clip(0, np.array(image.shape) - 1)
        near = [np.maximum(1 - np.abs(np.arange(n) - p), 0) for n, p in zip(image.shape, place, strict=True)]
        values[i, j] = near[0] @ image.astype(float) @ near[1]
    values -= values.mean()
    squares = (values**2).sum()
    if abs(squares - 25) < 1:
        return np.nan
    if squares < 25:
        return -1.0
    patch = patch_of(gray, row, column)
    return (values * patch).sum() / np.sqrt(squares * (patch**2).sum())


def alike(gray, grays, linear, b, row, column, plane):
    """Oracle: the mean of the best two correlations, -1 where nothing can be compared."""
    if (patch_of(gray, row, column) ** 2).sum() < 25 or not plane[0] > 0:
        return -1.0
    each = [correlation(gray, row, column, plane, *other) for other in zip(grays, linear, b, strict=True)]
    if any(c is not None and np.isnan(c) for c in each):
        return np.nan
    if all(c is None for c in each):
        return -1.0
    seen = [c for c in each if c is not None]
    best = sorted([*seen, *[max(max(seen) - ALONE, -1)] * (len(each) - len(seen))])[-2:]
    return sum(best) / len(best)


def nothing(planes):
    return Patches(planes, torch.full(planes.shape[:2], -1.0))


@cache
def random_planes(count, seed):
    """A scene, planes of its pixels, and how alike these are by the oracle."""
    scene = random_scene(count, seed)
    planes = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH, 3)) * [0.3, 0.02, 0.02] + [0.35, 0, 0]
    planes[0, :, 0] = np.linspace(-1, 40, WIDTH)
    planes = np.float32(planes)
    return scene, planes, {at: alike(*scene, *at, planes[at].astype(float)) for at in np.ndindex(HEIGHT, WIDTH)}


@pytest.mark.parametrize(("count", "seed"), [(1, 0), (3, 1), (4, 2)])
def test_planes_are_as_alike_as_single_pixels_say(count, seed):
    scene, planes, by_pixels = random_planes(count, seed)
    gray, others = operands(*scene)
    patches = compare_planes(gray, nothing(torch.zeros(HEIGHT, WIDTH, 3)), torch.from_numpy(planes), others, STRIDE)
    checked, compared = 0, 0
    for (r, c), expected in by_pixels.items():
        if np.isnan(expected):
            continue
        checked += 1
        compared += expected > -1
        assert float(patches.alike[r, c]) == pytest.approx(expected, abs=2e-3)
        is_taken = expected > -0.998
        assert (patches.planes[r, c].numpy() == (planes[r, c] if is_taken else 0)).all()
    assert checked > 0.8 * HEIGHT * WIDTH and compared > 0.3 * checked


def slanted_wall(count=2):
    """An image of one plane, others of it, and the plane at every pixel."""
    plane = np.array([0.3, 0.004, -0.003])  # inverse depth at pixel (0, 0), to the right, down
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    q = plane[0] + plane[1] * x + plane[2] * y
    linear, b = pinholes(count, 5, far=0.3)
    grays = []
    for m, shift in zip(linear, b, strict=True):
        # The homography of the plane, and its inverse where another image's pixels lie.
        back = np.linalg.inv(m + np.outer(shift, [plane[1], plane[2], plane[0]]))
        sizes = []
        for scale in (2.0, 1.0, 0.5):
            shape = int(HEIGHT * scale), int(WIDTH * scale)
            u, v = np.meshgrid(
                (np.arange(shape[1]) + 0.5) / shape[1] * WIDTH, (np.arange(shape[0]) + 0.5) / shape[0] * HEIGHT
            )
            at = back @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
            sizes.append(np.uint8(texture(*(at[:2] / at[2])).reshape(shape).clip(0, 255)))
        grays.append(sizes)
    planes = np.stack([q, np.full_like(q, plane[1]), np.full_like(q, plane[2])], -1)
    return (np.uint8(texture(x, y).clip(0, 255)), grays, linear, b), np.float32(planes)


def test_the_true_plane_is_alike_and_others_are_not():
    scene, planes = slanted_wall()
    gray, others = operands(*scene)
    true = compare_planes(gray, nothing(torch.from_numpy(planes)), torch.from_numpy(planes), others, STRIDE)
    wrong = torch.from_numpy(planes * np.float32([1.4, 1, 1]))
    false = compare_planes(gray, nothing(wrong), wrong, others, STRIDE)
    inner = np.s_[4:-4, 4:-4]
    assert true.alike[inner].median() > 0.95 and (true.alike >= false.alike)[inner].float().mean() > 0.9


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38, -1e38, 0.0])
def test_planes_that_are_none_are_never_taken(value):
    scene, planes = slanted_wall()
    gray, others = operands(*scene)
    good = compare_planes(gray, nothing(torch.from_numpy(planes)), torch.from_numpy(planes), others, STRIDE)
    good = Patches(good.planes, good.alike.clamp(min=0))
    for n in range(3):
        bad = torch.from_numpy(planes.copy())
        bad[..., n] = value
        if n and value == 0.0:
            continue
        after = compare_planes(gray, good, bad, others, STRIDE)
        assert torch.isfinite(after.alike).all() and torch.isfinite(after.planes).all()
        spread = spread_planes(gray, nothing(bad), torch.zeros(HEIGHT, WIDTH, 4), *floats(PINHOLE), others, STRIDE, 1)
        assert not spread.alike.isnan().any()
