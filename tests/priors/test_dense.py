"""Depths by dense matching, on rendered walls whose every depth is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from test_tracks import FOCAL, HEIGHT, LENS, POSES, WIDTH, is_near_wall, pose_at, scene_of

from mmpi_priors.dense import Depth, confirmed, find_depths
from mmpi_priors.views import camera_matrix, load_view, project

F32 = np.float32


@pytest.mark.parametrize("fisheye", [False, True])
def test_points_are_projected_as_by_opencv(tmp_path, fisheye):
    images = scene_of(tmp_path, POSES[:1], LENS, fisheye=fisheye)
    local = np.random.default_rng(0).uniform(-1, 1, (5000, 3)) - [0, 0, 2.5]
    local[:2] = [[0, 0, -2], [0, 0, 2]]
    at, still = project(images, 0, local @ POSES[0][:, :3].T + POSES[0][:, 3]), np.zeros(3)
    bend = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    lens = camera_matrix(images.intrinsics[0]), np.array(LENS)
    expected = bend((local * [1, -1, -1])[:, None], still, still, *lens)[0][:, 0]
    expected[1] = -1e4  # behind the camera
    assert at == pytest.approx(expected, abs=1e-7)


def true_depth(pose):
    """Depth along the axis [HEIGHT, WIDTH] of the walls of ``test_tracks.picture``, and which pixels show the near."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    directions = np.stack([(x - WIDTH / 2) / FOCAL, (HEIGHT / 2 - y) / FOCAL, -np.ones_like(x)], -1)
    d = directions @ pose[:, :3].T
    near, far = ((z - pose[2, 3]) / d[..., 2] for z in (-3.0, -5.0))
    shows_near = is_near_wall((pose[:, 3] + near[..., None] * d).reshape(-1, 3)).reshape(near.shape)
    return np.where(shows_near, near, far), shows_near


def points_on_walls(pose, count=40):
    """Exact points that a view sees, few and far between."""
    depth, _ = true_depth(pose)
    rng = np.random.default_rng(3)
    rows, columns = rng.integers(0, HEIGHT, count), rng.integers(0, WIDTH, count)
    x, y = (columns + 0.5 - WIDTH / 2) / FOCAL, (HEIGHT / 2 - rows - 0.5) / FOCAL
    local = np.stack([x, y, -np.ones_like(x)], -1) * depth[rows, columns, None]
    return local @ pose[:, :3].T + pose[:, 3]


def relative_errors(actual, poses):
    """Relative errors of the depths found, and errors over expected errors, of all views together."""
    pairs = [(d, true_depth(p)[0]) for (_, d), p in zip(actual, poses, strict=True)]
    error = np.concatenate([(d.inverse * t - 1)[d.inverse > 0] for d, t in pairs])
    scaled = np.concatenate([((d.inverse - 1 / t) / np.maximum(d.error, 1e-9))[d.inverse > 0] for d, t in pairs])
    return np.abs(error), np.abs(scaled)


@pytest.mark.parametrize(("lens", "fisheye"), [((0.0,) * 4, False), (LENS, False), ((0.0,) * 4, True)])
def test_most_pixels_get_their_depth_and_know_their_error(tmp_path, lens, fisheye):
    images = scene_of(tmp_path, POSES, lens, fisheye)
    actual = list(find_depths(images, lambda i: points_on_walls(POSES[i]), WIDTH))
    cover = np.mean([(d.inverse > 0).mean() for _, d in actual])
    error, scaled = relative_errors(actual, POSES)
    assert cover > 0.9
    assert np.median(error) < 0.003 and np.quantile(error, 0.9) < 0.02 and (error > 0.1).mean() < 0.04
    assert np.quantile(scaled, 0.9) < 2  # these walls are easier than the errors allow for
    assert all((d.error[d.inverse > 0] > 0).all() and not d.error[d.inverse == 0].any() for _, d in actual)


def test_without_points_nothing_false_is_believed(tmp_path):
    images = scene_of(tmp_path, POSES)
    actual = list(find_depths(images, lambda i: np.zeros((0, 3)), WIDTH))
    error, _ = relative_errors(actual, POSES)
    assert not len(error) or (error > 0.1).mean() < 0.05


def test_a_wall_without_texture_has_no_depth(tmp_path):
    images = scene_of(tmp_path, POSES, contrast=0.0)
    actual = list(find_depths(images, lambda i: points_on_walls(POSES[i]), WIDTH))
    assert not any(d.inverse.any() for _, d in actual)


def test_one_image_or_images_of_one_place_have_no_depth(tmp_path):
    one = scene_of(tmp_path / "one", POSES[:1])
    assert not any(d.inverse.any() for _, d in find_depths(one, lambda i: points_on_walls(POSES[i]), WIDTH))
    same = scene_of(tmp_path / "same", [POSES[0]] * 3)
    assert not any(d.inverse.any() for _, d in find_depths(same, lambda i: points_on_walls(POSES[0]), WIDTH))


def test_a_wrong_pose_gives_few_depths(tmp_path):
    """Epipolar lines that do not fit the images are noticed."""
    images = scene_of(tmp_path, POSES)
    right = list(find_depths(images, lambda i: points_on_walls(POSES[i]), WIDTH))
    moved = images.camera_to_worlds.copy()
    moved[:, 1, 3] += [0.15, -0.1, 0.22, -0.19, 0.04]
    wrong = list(find_depths(replace(images, camera_to_worlds=moved), lambda i: points_on_walls(POSES[i]), WIDTH))
    known = [sum((d.inverse > 0).sum() for _, d in f) for f in (right, wrong)]
    assert known[1] < 0.3 * known[0]


def flat_view(tmp_path, pose, gray=128):
    view = load_view(scene_of(tmp_path, [pose]), 0, WIDTH)
    return replace(view, gray=np.full_like(view.gray, gray))


def test_a_depth_counts_where_another_image_confirms_it_and_no_more_see_through_it(tmp_path):
    poses = [
        np.eye(4)[:3] + np.eye(4)[:3] * 0 + np.pad(np.array([[0.05 * i], [0], [0]]), ((0, 0), (3, 0))) for i in range(4)
    ]
    views = [flat_view(tmp_path / str(i), p) for i, p in enumerate(poses)]

    def at(depth):
        inverse = np.full(views[0].gray.shape, 1 / depth, F32)
        return Depth(inverse, 0.001 * inverse)

    middle = (slice(60, 90), slice(80, 120))

    def share(*depths):
        others = [(view, at(d)) for view, d in zip(views[1:], depths, strict=False)]
        return (confirmed(views[0], at(4.0), others).inverse[middle] > 0).mean()

    assert share(4.0) == share(4.0, 4.0, 8.0) == 1  # confirmed; confirmed twice, seen through once
    assert share(8.0) == share(4.0, 8.0) == share() == 0  # seen through; as often as confirmed; by nobody
    assert share(4.0, 2.0, 2.0) == 1  # hidden in the others, which says nothing


def test_what_moves_with_the_camera_has_no_depth(tmp_path):
    """A car ahead that keeps its distance on a straight road matches well, at infinity, which is no known depth."""
    poses = [pose_at(0.12 * i) for i in range(5)]
    images = scene_of(tmp_path, poses)
    car = np.random.default_rng(0).integers(0, 255, (50, 60), np.uint8)
    car = np.repeat(np.repeat(car[::5, ::5], 5, 0), 5, 1)
    for file in images.files:
        picture = np.array(Image.open(file))
        picture[50:100, 70:130] = car if picture.ndim == 2 else car[..., None]
        Image.fromarray(picture).save(file)
    actual = list(find_depths(images, lambda i: points_on_walls(poses[i]), WIDTH))
    inside = np.mean([(d.inverse[58:92, 78:122] > 0).mean() for _, d in actual])
    outside = np.mean([(d.inverse[:, :60] > 0).mean() for _, d in actual])
    assert inside < 0.05 and outside > 0.8
