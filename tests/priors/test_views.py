"""Images at working size, and where their pixels are in others."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hand_made import posed
from test_tracks import HEIGHT, LENS, POSES, WIDTH, scene_of

from mmpi_priors.views import Parallax, View, load_view


@pytest.mark.parametrize("size", [(1000, 500), (500, 1000)])
def test_the_longer_side_of_a_working_view_is_limited(tmp_path, size):
    """An upright photo has no more pixels than the same across; the pinhole follows each side."""
    cv2.imwrite(str(tmp_path / "photo.png"), np.zeros(size[::-1], np.uint8))
    pinhole = np.array([800.0, 900.0, 480.0, 260.0])
    images = posed(POSES[:1], pinhole, size, [tmp_path / "photo.png"])
    view = load_view(images, 0, 200)
    assert view.gray.shape[::-1] == (size[0] // 5, size[1] // 5)
    assert view.pinhole == pytest.approx(pinhole / 5)
    assert load_view(images, 0, 1000).gray.shape[::-1] == size


def test_a_reduced_view_shows_the_same(tmp_path):
    images = scene_of(tmp_path, POSES[:1], LENS)
    view = load_view(images, 0, WIDTH)
    half = view.reduced(2)
    assert half.gray.shape == half.inside.shape == (HEIGHT // 2, WIDTH // 2) and view.reduced(1) is view
    assert half.pinhole == pytest.approx(view.pinhole / 2)
    means = view.gray.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean((1, 3))
    assert np.abs(half.gray - means).max() <= 0.75
    assert load_view(scene_of(tmp_path / "straight", POSES[:1]), 0, WIDTH).reduced(4).inside.all()


@pytest.mark.parametrize("seed", range(3))
def test_parallax_is_that_of_points_in_both_cameras(seed):
    """Oracle: the points themselves, in float64."""
    rng = np.random.default_rng(seed)
    shape = (23, 31)
    views = []
    for _ in range(2):
        turn = np.linalg.qr(np.eye(3) + 0.2 * rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.diag(turn))
        pose = np.concatenate([turn, rng.normal(size=(3, 1))], -1)
        pinhole = np.array([30.0, 33.0, 15.0, 11.0]) + rng.normal(size=4)
        views.append(View(np.zeros(shape, np.uint8), pinhole, pose, np.ones(shape, bool)))
    inverse = rng.uniform(0.02, 0.2, shape).astype(np.float32)
    parallax = Parallax.between(*views)
    x, y, depth = parallax.pixels(inverse)
    columns, rows = np.meshgrid(np.arange(31) + 0.5, np.arange(23) + 0.5)
    fx, fy, cx, cy = views[0].pinhole
    local = np.stack([(columns - cx) / fx, (cy - rows) / fy, -np.ones(shape)], -1) / inverse.astype(float)[..., None]
    there = (local @ views[0].pose[:, :3].T + views[0].pose[:, 3] - views[1].pose[:, 3]) @ views[1].pose[:, :3]
    fx, fy, cx, cy = views[1].pinhole
    ahead = there[..., 2] < -1e-3
    assert 0.3 < ahead.mean()
    assert x[ahead] == pytest.approx((cx - fx * there[..., 0] / there[..., 2])[ahead], rel=1e-3, abs=2e-3)
    assert y[ahead] == pytest.approx((cy + fy * there[..., 1] / there[..., 2])[ahead], rel=1e-3, abs=2e-3)
    assert depth[ahead] == pytest.approx((-there[..., 2] * inverse)[ahead], rel=1e-4, abs=1e-5)
    assert (x[there[..., 2] > 1e-3] == -1e4).all() and (depth[there[..., 2] > 1e-3] == 0).all()
