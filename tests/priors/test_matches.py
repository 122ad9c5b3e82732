"""Places of pixels, depths of matches and their means against single pixels in float64 (ops/matches)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mmpi_priors.ops.matches import average_matches, compare_depths, follow_motion, place_pixels, solve_matches

ROWS, COLUMNS = 14, 37
NOISE, FARTHEST, MOST_RELATIVE = 0.3, 1.0, 0.15
pytestmark = pytest.mark.usefixtures("form")


def two_cameras(seed):
    """The linear part and the shift of homogeneous pixels between two cameras, rounded as the operation reads them."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.diag(turn))
    pinhole = np.array([[30.0, 0, 18], [0, 33.0, 7], [0, 0, 1]])
    linear, b = pinhole @ turn @ np.linalg.inv(pinhole), pinhole @ rng.normal(size=3)
    return np.float32(linear).astype(float), np.float32(b).astype(float)


def place(linear, b, row, column, q):
    """Oracle: where one point appears, and how far ahead. float64"""
    x, y, ahead = linear @ [column + 0.5, row + 0.5, 1.0] + q * b
    return np.array([x / ahead, y / ahead]), ahead


def tensors(*arrays):
    return [torch.from_numpy(np.asarray(x, np.float32)) for x in arrays]


@pytest.mark.parametrize("seed", range(3))
def test_pixels_appear_where_their_points_do(seed):
    linear, b = two_cameras(seed)
    b[2] = -1.0  # the other camera stands ahead, beyond the nearest points
    inverse = np.random.default_rng(seed).uniform(-0.4, 1.6, (ROWS, COLUMNS)).astype(np.float32)
    places = [p.numpy() for p in place_pixels(*tensors(inverse, linear, b))]
    behind = 0
    for r, c in np.ndindex(inverse.shape):
        at, ahead = place(linear, b, r, c, float(inverse[r, c]))
        if abs(ahead) < 1e-3:
            continue
        behind += ahead < 0
        expected = [-1e4, -1e4, 0] if ahead < 0 else [*at, ahead]
        assert [p[r, c] for p in places] == pytest.approx(expected, rel=1e-3 if ahead < 0.05 else 1e-4, abs=2e-3)
    assert 0 < behind < inverse.size / 2


def test_maps_are_read_where_pixels_moved_to():
    rng = np.random.default_rng(0)
    maps, motion = rng.normal(size=(2, ROWS, COLUMNS)), rng.normal(0, 4, (ROWS, COLUMNS, 2))
    motion[0, :6] = [[0, 0], [1e5, 0], [-1e5, 0], [0, 1e5], [0, -1e5], [COLUMNS - 6, 0]]
    maps, motion = maps.astype(np.float32), motion.astype(np.float32)
    moved = [part.numpy() for part in follow_motion(*tensors(*maps, motion))]
    for r, c in np.ndindex(ROWS, COLUMNS):
        place = np.array([r, c]) + motion[r, c, ::-1].astype(float)
        place = place.clip(0, np.array(maps[0].shape) - 1)
        for image, part in zip(maps.astype(float), moved, strict=True):
            near = [np.maximum(1 - np.abs(np.arange(n) - p), 0) for n, p in zip(image.shape, place, strict=True)]
            assert part[r, c] == pytest.approx(near[0] @ image @ near[1], abs=2e-5)


@pytest.mark.parametrize("seed", range(3))
def test_matches_tell_the_depth_and_how_certain_it_is(seed):
    """Half of the matches are exact, and give the depth that they were made from. The others lie up to 1.3 pixels
    beside: oracle is the least-squares solution of each alone, with its distance from the match."""
    rng = np.random.default_rng(seed)
    linear, b = two_cameras(seed)
    shape = ROWS, COLUMNS
    q, alike, usable = rng.uniform(0.02, 0.5, shape), rng.uniform(0.4, 1.2, shape), rng.random(shape) < 0.8
    exact = rng.random(shape) < 0.5
    at, expected, off, parallax, is_ahead = np.zeros((*shape, 2)), *np.zeros((4, *shape))
    for r, c in np.ndindex(shape):
        angle, aside = rng.uniform(0, 2 * np.pi), 0 if exact[r, c] else rng.uniform(0, 1.3)
        at[r, c] = place(linear, b, r, c, q[r, c])[0] + aside * np.array([np.cos(angle), np.sin(angle)])
        a, (x, y) = linear @ [c + 0.5, r + 0.5, 1.0], at[r, c]
        equations = np.array([[b[0] - x * b[2]], [b[1] - y * b[2]]]), np.array([x * a[2] - a[0], y * a[2] - a[1]])
        expected[r, c] = np.linalg.lstsq(*equations, rcond=None)[0][0]
        there, is_ahead[r, c] = place(linear, b, r, c, expected[r, c])
        off[r, c], parallax[r, c] = np.hypot(*(there - at[r, c])), np.hypot(*equations[0]) / is_ahead[r, c]
    maps = tensors(at[..., 0], at[..., 1], alike)
    solved = solve_matches(*maps, torch.from_numpy(usable), *tensors(linear, b), NOISE**2, FARTHEST**2)
    inverse, certainty = (x.numpy() for x in solved)
    sure = (is_ahead > 0.1) & (parallax > 3) & (np.abs(off - FARTHEST) > 0.01)
    kept = sure & usable & (off < FARTHEST)
    assert kept.sum() > 50 and not inverse[sure & ~kept].any() and not certainty[~usable].any()
    assert inverse[kept] == pytest.approx(expected[kept], abs=1e-4)
    assert inverse[kept & exact] == pytest.approx(q[kept & exact], abs=1e-4)
    variance = (NOISE**2 + off**2) * (11 - 10 * np.minimum(alike, 1))
    assert certainty[kept] == pytest.approx((parallax**2 / variance)[kept], rel=2e-3)


@pytest.mark.parametrize("what", ["no parallax", "not a number", "behind"])
def test_matches_that_tell_no_depth_have_none(what):
    linear, b = np.eye(3), np.array([0.0 if what == "no parallax" else 10.0, 0.0, 0.0])
    x, y = np.meshgrid(np.arange(COLUMNS) + 0.5, np.arange(ROWS) + 0.5)
    alike = np.full(x.shape, np.nan if what == "not a number" else 1.0)
    if what == "behind":
        linear[2, 2] = -1
    maps, usable = tensors(x + 0.5, y, alike), torch.ones(x.shape, dtype=torch.bool)
    inverse, certainty = solve_matches(*maps, usable, *tensors(linear, b), NOISE**2, FARTHEST**2)
    assert certainty.max() < 1e-9 and not inverse.any()


@pytest.mark.parametrize("seed", range(3))
def test_depths_are_compared_with_the_nearest_pixel_of_the_other_image(seed):
    rng = np.random.default_rng(seed)
    linear, b = two_cameras(seed)
    shape, other = (ROWS, COLUMNS), (17, 29)
    inverse, error = rng.uniform(-0.2, 0.5, shape).clip(0), rng.uniform(0, 0.02, shape)
    # A plane at one inverse depth, now and then nearer, farther or unknown.
    theirs, their_error = rng.choice([0, 0.1, 0.2, 0.3], other), rng.uniform(0, 0.02, other)
    depths = tensors(inverse, error, theirs, their_error)
    inverse, error, theirs, their_error = (x.numpy().astype(float) for x in depths)
    compared = [x.numpy() for x in compare_depths(*depths, *tensors(linear, b), 0.03)]
    counts, unsure = np.zeros(2, int), 0
    for r, c in np.ndindex(shape):
        at, ahead = place(linear, b, r, c, inverse[r, c])
        if np.abs(at - np.rint(at)).min() < 1e-3:  # between two pixels
            unsure += 1
            continue
        column, row = np.floor(at).astype(int)
        expected, says = inverse[r, c] / ahead, [False, False]
        if inverse[r, c] > 0 and ahead > 1e-6 and 0 <= column < 29 and 0 <= row < 17 and theirs[row, column] > 0:
            tolerance = 3 * np.sqrt(error[r, c] ** 2 + their_error[row, column] ** 2) + 0.03 * expected
            says = [abs(theirs[row, column] - expected) < tolerance, theirs[row, column] + tolerance < expected]
        assert [x[r, c] for x in compared] == says
        counts += says
    assert unsure < 10 and counts.min() > 5


def averaged_slowly(inverse, weight):
    """Oracle for one pixel."""
    best, mean, error = 0.0, 0.0, 0.0
    there = [n for n in range(len(weight)) if weight[n] > 0]
    for k in there:
        group = [n for n in there if (inverse[n] - inverse[k]) ** 2 < 2.5**2 * (1 / weight[n] + 1 / weight[k])]
        total = sum(weight[n] for n in group)
        average = sum(weight[n] * inverse[n] for n in group) / total
        scatter = sum(weight[n] * (inverse[n] - average) ** 2 for n in group) / max(len(group) - 1, 1)
        value = len(group) + total / sum(weight)
        if len(group) >= min(len(there), 2) and average > 0 and value > best:
            best, mean, error = value, average, np.sqrt(max(scatter, 1) / total)
    return (mean, error) if best > 0 and error < MOST_RELATIVE * mean else (0.0, 0.0)


@pytest.mark.parametrize("measurements", [1, 2, 4, 7, 20])
def test_the_largest_group_that_agrees_is_averaged(measurements):
    rng = np.random.default_rng(measurements)
    shape = measurements, 601
    inverse = rng.choice([0.2, 0.201, 0.21, 0.3, -0.1], shape) + rng.normal(0, 5e-4, shape)
    weight = rng.choice([0, 10, 1e4, 1e6, 1e7], shape)
    inverse, weight = (x.astype(np.float32) for x in (np.where(weight > 0, inverse, 0), weight))
    mean, error = (x[0].numpy() for x in average_matches(*tensors(inverse[:, None], weight[:, None]), MOST_RELATIVE))
    pixels = zip(inverse.T.astype(float), weight.T.astype(float), strict=True)
    expected = np.array([averaged_slowly(q, w) for q, w in pixels])
    same = np.isclose(mean, expected[:, 0], rtol=1e-5) & np.isclose(error, expected[:, 1], rtol=1e-3)
    assert same.mean() > 0.995 and (mean > 0).mean() > 0.3  # ties may fall either way
