"""Depths by dense matching, on rendered walls whose every depth is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from test_tracks import FOCAL, HEIGHT, LENS, POSES, WIDTH, is_near_wall, pose_at, scene_of

from mmpi_priors import dense
from mmpi_priors.dense import Depth, confirmed, find_depths, without_fringes
from mmpi_priors.ops.matches import average_matches
from mmpi_priors.views import camera_matrix, load_view, look_up, project

F32 = np.float32


def values_at(image, x, y, nearest):
    """Oracle of ``look_up`` for a list of places, float64: what is nearest, or interpolated within the borders."""
    x, y, image = np.float32(x) - 0.5, np.float32(y) - 0.5, image.astype(np.float64)
    height, width = image.shape[:2]
    if nearest:
        c, r = np.rint(x).astype(int), np.rint(y).astype(int)
        inside = (c >= 0) & (c < width) & (r >= 0) & (r < height)
        return np.where(inside, image[r.clip(0, height - 1), c.clip(0, width - 1)].T, 0).T
    x, y = x.clip(0, width - 1), y.clip(0, height - 1)
    c, r = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    u, v = (x - c, y - r) if image.ndim == 2 else ((x - c)[:, None], (y - r)[:, None])
    upper, lower = ((1 - u) * image[k, c] + u * image[k, c + 1] for k in (r, r + 1))
    return (1 - v) * upper + v * lower


@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3), (3, 70_000), (50_000, 2, 3), (2, 32_767), (8193, 3)])
@pytest.mark.parametrize("nearest", [True, False])
def test_images_and_lists_of_any_size_are_looked_up(shape, nearest):
    rng = np.random.default_rng(0)
    image = rng.random(shape).astype(F32)
    x, y = rng.uniform(-3, shape[1] + 3, 100_000), rng.uniform(-3, shape[0] + 3, 100_000)
    x[:9], y[:9] = [-1e4, 1e6, -1e6, 0, 0.5, shape[1], shape[1] - 0.5, 8192.5, 8192.2], 1.5
    expected = values_at(image, x, y, nearest)
    step = 0 if nearest else 1 / 32  # OpenCV rounds places to this much of a pixel
    assert np.abs(look_up(image, x, y, nearest=nearest) - expected).max() <= step + 1e-6
    folded = look_up(image, x.reshape(250, 400), y.reshape(250, 400), nearest=nearest)
    assert np.abs(folded.reshape(expected.shape) - expected).max() <= step + 1e-6
    assert look_up(image, x[:0], y[:0], nearest=nearest).shape == (0, *shape[2:])


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


def relative_errors(found, poses):
    """Relative errors of the depths found, and errors over expected errors, of all views together."""
    pairs = [(d, true_depth(p)[0]) for (_, d), p in zip(found, poses, strict=True)]
    error = np.concatenate([(d.inverse * t - 1)[d.inverse > 0] for d, t in pairs])
    scaled = np.concatenate([((d.inverse - 1 / t) / np.maximum(d.error, 1e-9))[d.inverse > 0] for d, t in pairs])
    return np.abs(error), np.abs(scaled)


@pytest.mark.parametrize(("lens", "fisheye"), [((0.0,) * 4, False), (LENS, False), ((0.0,) * 4, True)])
def test_most_pixels_get_their_depth_and_know_their_error(tmp_path, lens, fisheye):
    images = scene_of(tmp_path, POSES, lens, fisheye)
    found = list(find_depths(images, lambda i: points_on_walls(POSES[i]), WIDTH))
    cover = np.mean([(d.inverse > 0).mean() for _, d in found])
    error, scaled = relative_errors(found, POSES)
    assert cover > 0.9
    assert np.median(error) < 0.003 and np.quantile(error, 0.9) < 0.02 and (error > 0.1).mean() < 0.04
    assert np.quantile(scaled, 0.9) < 2  # these walls are easier than the errors allow for
    assert all((d.error[d.inverse > 0] > 0).all() and not d.error[d.inverse == 0].any() for _, d in found)


def test_without_points_nothing_false_is_believed(tmp_path):
    images = scene_of(tmp_path, POSES)
    found = list(find_depths(images, lambda i: np.zeros((0, 3)), WIDTH))
    error, _ = relative_errors(found, POSES)
    assert not len(error) or (error > 0.1).mean() < 0.05


def test_a_wall_without_texture_has_no_depth(tmp_path):
    images = scene_of(tmp_path, POSES, contrast=0.0)
    found = list(find_depths(images, lambda i: points_on_walls(POSES[i]), WIDTH))
    assert not any(d.inverse.any() for _, d in found)


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


def mean_of(values, weights):
    """The mean of measurements of one pixel, and its error."""
    columns = (torch.tensor(each).reshape(-1, 1, 1) for each in (values, weights))
    return tuple(x.item() for x in average_matches(*columns, dense.MAX_RELATIVE))


def test_measurements_that_agree_are_averaged_by_certainty():
    inverse, error = mean_of((1.0, 1.005, 3.0), (1e4, 4e4, 1e8))
    assert inverse == pytest.approx((1.0 + 4 * 1.005) / 5)
    assert error == pytest.approx(np.sqrt(1 / 5e4))


def test_an_error_is_never_less_than_the_scatter_says():
    """Errors of 0.01 each, values 0.03 apart: they agree (2.5 of sqrt 2 times 0.01), and scatter by 4.5 variances."""
    assert mean_of((1.0, 1.03), (1e4, 1e4))[1] == pytest.approx(np.sqrt(4.5 / 2e4), rel=1e-4)


def flat_view(tmp_path, pose, gray=128):
    view = load_view(scene_of(tmp_path, [pose]), 0, WIDTH)
    return replace(view, gray=np.full_like(view.gray, gray))


def test_the_fringe_of_a_foreground_goes_where_it_has_no_texture_of_its_own(tmp_path):
    view = flat_view(tmp_path, POSES[0])
    inverse = np.full(view.gray.shape, 0.1, F32)
    inverse[:, 100:] = 0.5
    depth = Depth(inverse, 0.001 * inverse)
    kept = without_fringes(view, depth).inverse > 0
    half = dense.EDGE // 2
    assert kept[:, :100].all() and not kept[:, 100 : 100 + half].any() and kept[:, 100 + half :].all()
    rng = np.random.default_rng(0)
    textured = replace(view, gray=rng.integers(0, 255, view.gray.shape, dtype=np.uint8))
    assert (without_fringes(textured, depth).inverse > 0).mean() > 0.99


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
    found = list(find_depths(images, lambda i: points_on_walls(poses[i]), WIDTH))
    inside = np.mean([(d.inverse[58:92, 78:122] > 0).mean() for _, d in found])
    outside = np.mean([(d.inverse[:, :60] > 0).mean() for _, d in found])
    assert inside < 0.05 and outside > 0.8
