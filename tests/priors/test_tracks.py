"""Tracks found among posed images, on rendered walls whose every point is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from corridor import noise
from hand_made import posed
from PIL import Image
from tiny_scene import undistort

from mmpi_ns.placement.observations import Observations
from mmpi_priors.observe import with_tracks
from mmpi_priors.tracks import triangulate
from mmpi_priors.views import camera_matrix

WIDTH, HEIGHT, FOCAL = 200, 150, 180.0
LENS = (0.05, -0.02, 0.001, -0.002)


def pose_at(x, turn=0.0):
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, 0, s, x], [0, 1, 0, 0.03 * x], [-s, 0, c, 0.1 * x]])


def texture(x, y, seed):
    return noise(x, y, np.random.default_rng(seed).random((2, 64, 64)), ((6.0, 0.5), (14.0, 0.5)))


def is_near_wall(points):
    return points[:, 0] < 0.2


def undistort_fisheye(x, y, lens):
    """The same of OpenCV's fisheye."""
    points = np.stack([x, y], -1).reshape(-1, 1, 2)
    return np.moveaxis(cv2.fisheye.undistortPoints(points, np.eye(3), np.array(lens)).reshape(*x.shape, 2), -1, 0)


def picture(pose, lens, fisheye=False):
    """Gray image of a near wall (z = -3, x < 0.2) before a far one (z = -5)."""
    xs, ys = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    inverse = undistort_fisheye if fisheye else undistort
    u, v = inverse((xs - WIDTH / 2) / FOCAL, (ys - HEIGHT / 2) / FOCAL, lens)
    d = np.stack([u, -v, -np.ones_like(u)], -1).reshape(-1, 3) @ pose[:, :3].T
    near, far = ((z - pose[2, 3]) / d[:, 2] for z in (-3.0, -5.0))
    a, b = pose[:, 3] + near[:, None] * d, pose[:, 3] + far[:, None] * d
    gray = np.where(is_near_wall(a), texture(a[:, 0], a[:, 1], 1), texture(b[:, 0], b[:, 1], 2))
    return gray.reshape(HEIGHT, WIDTH)


def scene_of(folder, poses, lens=(0.0, 0.0, 0.0, 0.0), fisheye=False, contrast=1.0):
    folder.mkdir(exist_ok=True)
    files = []
    for i, pose in enumerate(poses):
        files.append(folder / f"view{i}.png")
        gray = 0.5 + contrast * (picture(pose, lens, fisheye) - 0.5)
        Image.fromarray((gray * 255).round().astype(np.uint8)).save(files[-1])
    return posed(poses, [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], [WIDTH, HEIGHT], files, lens, fisheye)


POSES = [pose_at(0.12 * i, 0.02 * i) for i in range(5)]


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return scene_of(tmp_path_factory.mktemp("walls"), POSES, LENS)


@pytest.fixture(scope="module")
def model(images):
    return triangulate(images)


def depth_error(points):
    """How far points lie from the nearer of the two walls, relative to its depth."""
    return np.minimum(np.abs(points[:, 2] + 3) / 3, np.abs(points[:, 2] + 5) / 5)


def test_points_lie_on_the_walls(model):
    assert len(model.points) > 100
    assert np.median(depth_error(model.points)) < 0.005
    assert np.quantile(depth_error(model.points), 0.95) < 0.05
    near = np.abs(model.points[:, 2] + 3) < 0.3
    assert 0.1 < near.mean() < 0.9
    assert is_near_wall(model.points[near]).mean() > 0.97


def test_a_fisheye_lens_is_taken_for_what_it_is(tmp_path):
    images = scene_of(tmp_path, POSES, (0.08, -0.03, 0.02, 0.01), fisheye=True)
    points = triangulate(images).points
    assert len(points) > 100 and np.median(depth_error(points)) < 0.005
    others = triangulate(replace(images, fisheye=False)).points
    assert not len(others) or np.median(depth_error(others)) > 0.01


def keypoints_of(model, images):
    """Image, point and relative place of each keypoint."""
    cameras = Observations(images.camera_to_worlds, images.intrinsics, images.sizes)
    seen = with_tracks(cameras, model)
    return seen.seen_by, seen.seen_point, seen.seen_at / images.sizes[seen.seen_by]


def test_keypoints_are_where_the_points_project(images, model):
    cameras, points, relative = keypoints_of(model, images)
    assert len(cameras) >= 3 * len(model.points)
    pixels = np.zeros(relative.shape)
    for i, pose in enumerate(images.camera_to_worlds):
        seen = (model.points[points[cameras == i]] - pose[:, 3]) @ pose[:, :3] * [1, -1, -1]
        still, matrix = np.zeros(3), camera_matrix(images.intrinsics[i])
        pixels[cameras == i] = cv2.projectPoints(seen, still, still, matrix, np.array(LENS))[0][:, 0]
    error = np.linalg.norm(pixels - relative * [WIDTH, HEIGHT], axis=-1)
    assert np.median(error) < 0.5 and error.max() < 6


def test_disturbed_poses_show_in_the_matches_and_exact_ones_do_not(images, model):
    """Turned by half a degree, a camera sees its matches 1.6 pixels off."""
    assert model.off is not None and model.off * WIDTH < 0.25
    turned = images.camera_to_worlds.copy()
    for i in (1, 3):
        c, s = np.cos(np.radians(0.5)), np.sin(np.radians(0.5))
        turned[i, :, :3] = turned[i, :, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    off = triangulate(replace(images, camera_to_worlds=turned)).off
    assert off is not None and 0.6 < off * WIDTH < 2


def test_an_unreadable_image_is_named(tmp_path):
    images = scene_of(tmp_path, POSES[:2])
    images.files[1].write_text("not an image")
    with pytest.raises(ValueError, match=r"view1\.png cannot be read"):
        triangulate(images)
