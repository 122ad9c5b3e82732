"""Surfaces found by patches of planes, in a corridor of which images far apart show the walls at different sizes."""

from __future__ import annotations

from functools import cache

import numpy as np
from corridor import noise

from mmpi_priors.dense import ROUNDS, confirmed, matched
from mmpi_priors.patches import Surfaces, search_surfaces
from mmpi_priors.views import View

WIDTH, HEIGHT, FOCAL, STEP = 240, 180, 170.0, 1.3
WALLS = ((0, -1.0), (0, 1.2), (1, -0.8), (1, 1.5), (2, -9.0))
"""Axis and coordinate of each."""


@cache
def corridor(i, contrast=0.3, noise_levels=6.0):
    """A noisy view down the corridor, i steps in, and its inverse depths. [HEIGHT, WIDTH]"""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    directions, center = np.stack([x / FOCAL, -y / FOCAL, -np.ones_like(x)]), np.array([0.0, 0, -STEP * i])
    distances = []
    for axis, at in WALLS:
        along = (at - center[axis]) / np.where(directions[axis] == 0, 1e-9, directions[axis])
        distances.append(np.where(along > 0, along, np.inf))
    wall, depth = np.argmin(distances, 0), np.min(distances, 0)
    points = center[:, None, None] + depth * directions
    gray = np.zeros_like(depth)
    for n, (axis, _) in enumerate(WALLS):
        u, v = (points[k][wall == n] for k in range(3) if k != axis)
        gray[wall == n] = noise(u, v, np.random.default_rng(n).random((2, 64, 64)), ((3.0, 0.5), (9.0, 0.5)))
    pose = np.concatenate([np.eye(3), center[:, None]], 1)
    pixels = 255 * (0.5 + contrast * (gray - 0.5)) + noise_levels * np.random.default_rng(i).normal(size=gray.shape)
    pixels = pixels.round().clip(0, 255).astype(np.uint8)
    return View(pixels, np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]), pose, np.ones(depth.shape, bool)), 1 / depth


def views():
    return [corridor(i)[0] for i in range(4)]


def few_points(i, count=4):
    rng = np.random.default_rng(i)
    view, inverse = corridor(i)
    rows, columns = rng.integers(0, HEIGHT, count), rng.integers(0, WIDTH, count)
    at = np.stack([columns + 0.5 - WIDTH / 2, HEIGHT / 2 - rows - 0.5, np.full(count, -FOCAL)], -1) / FOCAL
    return view.pose[:, 3] + at / inverse[rows, columns, None]


def depths(rounds=None):
    all_views = views()
    near = [[all_views[j] for j in range(4) if j != i] for i in range(4)]
    each = [matched(view, near[i], few_points(i), rounds) for i, view in enumerate(all_views)]
    return [
        confirmed(view, each[i], [(all_views[j], each[j]) for j in range(4) if j != i])
        for i, view in enumerate(all_views)
    ]


def cover_and_errors(maps):
    truth = [corridor(i)[1] for i in range(4)]
    right = [np.abs(d.inverse / t - 1) < 0.1 for d, t in zip(maps, truth, strict=True)]
    error = np.concatenate([np.abs(d.inverse / t - 1)[d.inverse > 0] for d, t in zip(maps, truth, strict=True)])
    scaled = [
        (np.abs(d.inverse - t) / np.maximum(d.error, 1e-9))[d.inverse > 0] for d, t in zip(maps, truth, strict=True)
    ]
    return np.mean(right), error, np.concatenate(scaled)


def test_walls_that_grow_from_image_to_image_have_depths():
    flow, _, _ = cover_and_errors(depths(ROUNDS[False]))
    cover, error, scaled = cover_and_errors(depths())
    assert cover > 0.5 and cover > 1.3 * flow, (cover, flow)
    assert np.median(error) < 0.02 and (error > 0.1).mean() < 0.06
    assert np.quantile(scaled, 0.8) < 2


def test_planes_are_slanted_as_the_walls_are():
    view, inverse = corridor(1)
    others = [corridor(i)[0] for i in (0, 2, 3)]
    surfaces = search_surfaces(view, others, np.full(inverse.shape, 0.3, np.float32))
    assert surfaces is not None
    shape = surfaces.error.shape
    factor = WIDTH / shape[1]
    rows, columns = (
        np.minimum((factor * (np.arange(n) + 0.5)).astype(int), m - 1)
        for n, m in zip(shape, inverse.shape, strict=True)
    )
    right = (np.gradient(inverse, axis=1) * factor)[np.ix_(rows, columns)]
    side = (surfaces.error > 0) & (np.abs(right) > 0.004)  # of the walls to the left and right
    assert side.sum() > 1000
    assert np.median(np.abs(surfaces.planes[..., 1][side] / right[side] - 1)) < 0.1
    inverse_there, error = surfaces.enlarged(inverse.shape)
    certain = error > 0
    assert np.median(np.abs(inverse_there / inverse - 1)[certain]) < 0.02
    again = search_surfaces(view, others, np.full(inverse.shape, 0.3, np.float32))
    assert again is not None and (again.planes == surfaces.planes).all()


def test_steps_in_depth_have_a_margin():
    planes = np.zeros((20, 30, 3), np.float32)
    planes[..., 0] = np.where(np.arange(30) < 12, 1.0, 0.5)
    planes[5, 3, 0] = 0.95 * planes[5, 2, 0]  # no step
    error = np.full((20, 30), 0.01, np.float32)
    error[0, 0] = 0
    inverse, error = Surfaces(planes, error).enlarged(error.shape)
    assert not error[:, 10:14].any() and (error[1:, :10] > 0).all() and (error[:, 14:] > 0).all()
    assert inverse[0, 0] == 0 and np.array_equal(inverse > 0, error > 0)


def test_where_nothing_can_be_compared_there_are_no_surfaces():
    view, inverse = corridor(1)
    others, rough = [corridor(0)[0], corridor(2)[0]], np.ones(inverse.shape, np.float32)
    assert search_surfaces(view, [], rough) is None
    assert search_surfaces(view.reduced(60), [other.reduced(60) for other in others], rough[:3, :4]) is None
    blanks = [corridor(i, 0.0, 0.0)[0] for i in range(3)]
    blank = search_surfaces(blanks[1], blanks[::2], rough)
    assert blank is not None and not blank.error.any() and not blank.inverse.any()
    assert search_surfaces(view, [view, view], rough) is None  # no parallax
