"""Depths continued into what hardly another image shows: planes go on, nothing else does, and errors say how far."""

from __future__ import annotations

import numpy as np
import pytest
from hand_made import posed

from mmpi_priors.lone_depth import LEAST_ERROR, MOST_ERROR, continued, is_lone

F32 = np.float32
WIDTH, HEIGHT, FOCAL = 96, 64, 60.0


def directions(shape=(HEIGHT, WIDTH), focal=FOCAL):
    """Unit directions of a pinhole's pixels, its own axes (OpenGL). [H, W, 3]"""
    rows, columns = np.indices(shape) + 0.5
    d = np.stack([(columns - shape[1] / 2) / focal, (shape[0] / 2 - rows) / focal, -np.ones(shape)], -1)
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(F32)


def plane(normal, distance, d):
    """Inverse distances of the plane normal . x = distance, by meeting each ray with it."""
    t = distance / (d.astype(np.float64) @ np.asarray(normal, float))
    return np.where(t > 0, 1 / np.where(t > 0, t, 1), 0)


def seen(inverse, kept, error=0.01):
    inverse = np.where(kept, inverse, 0)
    return np.stack([inverse, error * inverse], -1).astype(F32)


def middle(margin=24):
    kept = np.zeros((HEIGHT, WIDTH), bool)
    kept[margin // 2 : -margin // 2, margin:-margin] = True
    return kept


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, 0.1, -0.8), (0.3, -0.9, -0.3), (-0.7, 0.0, -0.7)])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_a_plane_goes_on(normal, unit):
    """Where a slanted plane is known in the middle, its distances follow outside, in any unit of length."""
    d, kept = directions(), middle()
    exact = plane(normal, 5 * unit, d)
    actual = continued(seen(exact, kept & (exact > 0)), d)
    added = actual[..., 0] > 0
    assert not added[kept].any()
    assert added[~kept & (exact > 0)].mean() > 0.6
    relative = np.abs(actual[added][:, 0] / exact[added] - 1)
    assert (
        np.median(relative) < 0.01
        and (relative < np.maximum(3 * actual[added][:, 1] / actual[added][:, 0], 1e-3)).all()
    )


def test_errors_grow_with_the_way_that_is_continued():
    d = directions()
    noise = 1 + 0.02 * np.random.default_rng(0).standard_normal((HEIGHT, WIDTH))
    actual = continued(seen(plane((0.2, 0, -1), 5, d) * noise, middle(30)), d)
    relative = (actual[..., 1] / np.maximum(actual[..., 0], 1e-9))[HEIGHT // 2]
    assert relative[29] >= LEAST_ERROR * 0.999 and relative[8] > 1.2 * relative[28]
    assert relative.max() < MOST_ERROR


def test_what_is_no_plane_is_not_continued():
    """Distances without any order, a factor of ten apart."""
    kept = middle()
    inverse = 10 ** np.random.default_rng(1).uniform(-1, 0, (HEIGHT, WIDTH))
    actual = continued(seen(inverse, kept), directions())
    assert (actual[..., 0] > 0).mean() < 0.02


def test_nothing_known_or_everything_known_adds_nothing():
    d = directions()
    assert not continued(np.zeros((HEIGHT, WIDTH, 2), F32), d).any()
    assert not continued(seen(plane((0, 0, -1), 5, d), np.ones((HEIGHT, WIDTH), bool)), d).any()


def ahead(*places):
    """Cameras that look along -z from these places."""
    poses = np.tile(np.eye(4)[:3], (len(places), 1, 1))
    poses[:, :, 3] = places
    return posed(poses, [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], [WIDTH, HEIGHT])


def test_a_point_is_lone_that_at_most_one_other_image_shows():
    """The second camera stands further on: it sees the middle of what the first one sees, nothing behind itself."""
    images = ahead((0, 0, 0), (0, 0, -3), (0, 0, -3.5))
    points = np.array([[0.0, 0, -10], [7.0, 0, -10], [0.0, 0, -2], [5.4, 0.0, -10]])
    assert is_lone(images, 0, points).tolist() == [False, True, True, True]  # borders: 0.8 (10 - 3), 0.8 (10 - 3.5)
    assert is_lone(images, 1, points[:1]).tolist() == [False]
    assert is_lone(ahead((0, 0, 0)), 0, points).tolist() == [True] * 4
    assert is_lone(images, 0, np.zeros((0, 3))).shape == (0,)
