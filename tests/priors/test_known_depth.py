"""Distances at training pixels: from working size, through lenses, from points and from sensors."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hand_made import observed, posed

from mmpi_ns.data.priors import UNKNOWN, DepthPriors, packed
from mmpi_priors.dense import Depth
from mmpi_priors.depth_priors import POINT_ERROR, SENSOR_ERROR, at_training_pixels, with_points, with_sensor
from mmpi_priors.views import View

F32 = np.float32
STEP = 3.5e-4
"""Relative error of a stored distance."""
WIDTH, HEIGHT = 80, 60


def camera(lens=(0.0, 0.0, 0.0, 0.0), fisheye=False):
    return posed(np.eye(4)[None, :3], [60, 60, 40, 30], [WIDTH, HEIGHT], lens=lens, fisheye=fisheye)


def photographed(folder):
    """The camera with its image."""
    cv2.imwrite(str(folder / "x.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    return replace(camera(), files=(folder / "x.png",))


def slanted(pinhole, shape):
    """Inverse depth of a slanted plane: affine in the pinhole's pixels."""
    y, x = np.meshgrid(np.arange(shape[0]) + 0.5, np.arange(shape[1]) + 0.5, indexing="ij")
    return 0.5 + 0.2 * (x - pinhole[2]) / pinhole[0] + 0.1 * (y - pinhole[3]) / pinhole[1]


@pytest.mark.parametrize(("lens", "fisheye"), [((0, 0, 0, 0), False), ((0.1, -0.05, 0.002, -0.001), False),
                                               ((0.08, -0.03, 0.02, 0.01), True), ((0, 0, 0, 0), True)])  # fmt: skip
def test_a_training_pixel_gets_the_distance_of_what_it_shows(lens, fisheye):
    """Oracle: the training pixels' rays by OpenCV's own lens model, met with the plane."""
    image = camera(lens, fisheye)
    pinhole, shape = image.intrinsics[0], (HEIGHT, WIDTH)
    inverse = slanted(pinhole, shape).astype(F32)
    view = View(np.zeros(shape, np.uint8), pinhole, image.camera_to_worlds[0], np.ones(shape, bool))
    actual = at_training_pixels(view, Depth(inverse, 0.01 * inverse), image, 0, (15, 20))
    rows, columns = np.meshgrid(np.arange(15) + 0.5, np.arange(20) + 0.5, indexing="ij")
    at = np.stack([columns * 4, rows * 4], -1).reshape(-1, 1, 2)
    matrix = np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]])
    straight = (cv2.fisheye if fisheye else cv2).undistortPoints(at, matrix, np.array(lens, float))[:, 0]
    u, v = straight.T.reshape(2, 15, 20)
    expected = (0.5 + 0.2 * u + 0.1 * v) / np.sqrt(u**2 + v**2 + 1)
    known = actual[..., 0] > 0
    assert known.mean() > 0.75
    assert actual[known][:, 0] == pytest.approx(expected[known], rel=0.04 if any(lens) or fisheye else 1e-3)
    assert (actual[known][:, 1] > 0.009 * actual[known][:, 0]).all()


def test_a_copy_whose_size_was_rounded_shows_the_whole_original():
    """1242 x 375 as 310 x 93: pixel 300 of the copy lies at 300.5 * 1242/310 of the original."""
    image = posed(np.eye(4)[None, :3], [720, 720, 610, 170], [1242, 375])
    shape, pinhole = (188, 621), np.array([720.0 * 621 / 1242, 720.0 * 188 / 375, 610 * 621 / 1242, 170 * 188 / 375])
    inverse = slanted(pinhole, shape).astype(F32)
    view = View(np.zeros(shape, np.uint8), pinhole, np.eye(4)[:3], np.ones(shape, bool))
    actual = at_training_pixels(view, Depth(inverse, 0.01 * inverse), image, 0, (93, 310))
    u, v = (300.5 * 1242 / 310 - 610) / 720, (10.5 * 375 / 93 - 170) / 720
    # The pixel that is looked up lies within half a training pixel of the exact place.
    assert actual[10, 300, 0] == pytest.approx((0.5 + 0.2 * u + 0.1 * v) / np.sqrt(u * u + v * v + 1), rel=3e-3)


def test_areas_take_the_mean_by_certainty_and_edges_have_large_errors():
    inverse, error = np.full((4, 8), 0.5, F32), np.full((4, 8), 0.01, F32)
    inverse[:, 4:6], error[:, 5] = 0.1, 0.01  # an edge inside the third area of 2 x 2: none; inside the fourth: below
    inverse[:2, 7] = 0.9
    inverse[2:, :3], error[2:, :3] = 0, 0
    pinhole, pose = np.array([1e6, 1e6, 4, 2]), np.eye(4)[:3]  # all along the axis
    view = View(np.zeros((4, 8), np.uint8), pinhole, pose, np.ones((4, 8), bool))
    image = posed(pose[None], pinhole, [8, 4])
    mean, spread = np.moveaxis(at_training_pixels(view, Depth(inverse, error), image, 0, (2, 4)), -1, 0)
    assert mean[0] == pytest.approx([0.5, 0.5, 0.1, 0.7]) and spread[0, :3] == pytest.approx([0.01] * 3, rel=1e-3)
    assert spread[0, 3] == pytest.approx(np.hypot(0.2, 0.01), rel=1e-3)
    assert mean[1, 0] == 0 and mean[1, 1] == pytest.approx(0.5)  # nothing known; half of the area known


def nothing_known():
    return DepthPriors([np.full((60, 80, 2), UNKNOWN, np.int16)] * 2)


def seen(points, cameras, at):
    """Observations of a camera at the origin and one a unit behind it."""
    poses = np.tile(np.eye(4)[:3], (2, 1, 1))
    poses[1, 2, 3] = 1
    return observed(poses, [60, 60, 40, 30], [80, 60], points, cameras, seen_at=at)


def test_points_set_the_distance_of_the_pixels_that_saw_them_the_nearest_where_several_did():
    observations = seen([[0, 0, -4], [0, 0, -2], [0, 0, -3]], [0, 0, 1], [[40.9, 30.2], [40.1, 30.7], [3, 5]])
    nothing = nothing_known()
    actual = with_points(nothing, observations)
    first, second = actual.image(0), actual.image(1)
    assert first[30, 40] == pytest.approx([0.5, POINT_ERROR / 2], rel=STEP) and (first[..., 0] > 0).sum() == 1
    assert second[5, 3] == pytest.approx([0.25, POINT_ERROR / 4], rel=STEP) and nothing.share == 0
    assert actual.share == pytest.approx(2 / (2 * 80 * 60))


@pytest.mark.parametrize("suffix", ["png", "npy"])
def test_a_depth_image_of_a_sensor_is_along_the_axis_in_its_unit_and_0_is_unknown(tmp_path, suffix):
    file = tmp_path / f"depth.{suffix}"
    depth = np.full((HEIGHT, WIDTH), 3000, np.uint16)
    depth[:, 40:] = 0
    np.save(file, depth) if suffix == "npy" else cv2.imwrite(str(file), depth)
    image = photographed(tmp_path)
    half = replace(image, intrinsics=image.intrinsics / 2, sizes=image.sizes / 2)
    actual = with_sensor(DepthPriors([packed(np.zeros((30, 40, 2)))]), [file], 0.002, half).image(0)
    u, v = (5.5 * 2 - 40) / 60, (3.5 * 2 - 30) / 60
    assert actual[3, 5] == pytest.approx(np.array([1, SENSOR_ERROR]) / (6 * np.sqrt(u * u + v * v + 1)), rel=STEP)
    assert not actual[:, 20:].any()


def test_a_sensor_goes_before_other_sources_where_it_knows_something(tmp_path):
    depth = np.zeros((HEIGHT, WIDTH), np.uint16)
    depth[:30] = 2000
    cv2.imwrite(str(tmp_path / "d.png"), depth)
    before = DepthPriors([packed(np.full((HEIGHT, WIDTH, 2), 0.25))])
    actual = with_sensor(before, [tmp_path / "d.png"], 1e-3, photographed(tmp_path)).image(0)
    assert (actual[30:] == 0.25).all() and actual[29, 40, 0] == pytest.approx(0.5, rel=1e-3)


def test_a_sensor_and_matches_that_contradict_each_other_are_both_left_out(tmp_path):
    depth = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    depth[:, 40:] = 0
    cv2.imwrite(str(tmp_path / "d.png"), depth)
    sensor = with_sensor(
        DepthPriors([packed(np.zeros((HEIGHT, WIDTH, 2)))]), [tmp_path / "d.png"], 1e-3, photographed(tmp_path)
    ).image(0)
    matched = np.stack([1.8 * sensor[..., 0], np.full((HEIGHT, WIDTH), 0.01, F32)], -1)  # as a mirror shows
    matched[:20, :, 0] = 1.02 * sensor[:20, :, 0]  # within the errors
    matched[:, 40:] = 0.25  # the sensor says nothing
    matched[50:] = 0  # the matches say nothing
    actual = with_sensor(DepthPriors([packed(matched)]), [tmp_path / "d.png"], 1e-3, photographed(tmp_path)).image(0)
    assert (actual[20:50, :40] == 0).all()
    assert (actual[:20, :40] == sensor[:20, :40]).all() and (actual[50:, :40] == sensor[50:, :40]).all()
    assert (actual[:50, 40:] == 0.25).all() and sensor[0, 0, 0] > 0.3


@pytest.mark.parametrize("content", [None, b"no image"])
def test_a_depth_image_that_cannot_be_read_is_named(tmp_path, content):
    file = tmp_path / "lost.png"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ValueError, match=r"lost\.png"):
        with_sensor(DepthPriors([packed(np.zeros((HEIGHT, WIDTH, 2)))]), [file], 1e-3, photographed(tmp_path)).image(0)
