"""The captured path in nerfstudio's viewer."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmpi_ns.viewer import CapturedPath, fitting_fov


def street(count=13):
    """Cameras a unit apart that look along -x, up is z; the first is rolled by ten degrees."""
    poses = np.zeros((count, 3, 4))
    poses[:, 1, 0] = poses[:, 2, 1] = poses[:, 0, 2] = 1  # right y, up z, backwards x
    poses[:, 0, 3] = -np.arange(count)
    roll = np.radians(10)
    poses[0, :, :2] = poses[0, :, :2] @ [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    return poses


def test_a_window_opens_in_the_middle_of_the_first_third():
    assert CapturedPath(street(13)).start == 2


def test_the_path_passes_through_every_camera():
    path = CapturedPath(street())
    for i in range(13):
        assert_allclose(path.at(i).position, [-i, 0, 0], atol=1e-12)
        assert_allclose(path.at(i).direction, [-1, 0, 0], atol=1e-12)


def test_between_cameras_of_a_straight_road_one_walks_straight():
    assert_allclose(CapturedPath(street()).at(4.25).position, [-4.25, 0, 0], atol=1e-12)


def test_a_path_of_one_camera_is_that_camera():
    path = CapturedPath(street(1))
    assert path.start == 0
    assert_allclose(path.at(0).position, 0, atol=1e-12)


def test_one_rolled_camera_leaves_the_horizon_level():
    assert np.degrees(np.arccos(CapturedPath(street()).up[2])) < 1


def test_the_nearest_camera():
    assert CapturedPath(street()).nearest(np.array([-6.6, 3.0, 0.0])) == 7


@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 4.0])
def test_a_window_lies_inside_the_image(aspect):
    half_height = np.tan(fitting_fov(1.0, 0.5, aspect) / 2)
    assert half_height <= 0.5 + 1e-12 and half_height * aspect <= 1 + 1e-12
    assert half_height == pytest.approx(0.5) or half_height * aspect == pytest.approx(1.0)
