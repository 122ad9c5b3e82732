"""The nearest views that face the same way."""

from __future__ import annotations

import numpy as np

from mmpi_ns.placement.observations import nearest_views


def poses_of(places, angles):
    """Cameras on a line that look along -z, turned about y (degrees)."""
    turned = []
    for place, angle in zip(places, np.radians(angles), strict=True):
        c, s = np.cos(angle), np.sin(angle)
        turned.append(np.array([[c, 0, s, place], [0, 1, 0, 0], [-s, 0, c, 0]]))
    return np.stack(turned)


def test_they_come_nearest_first_without_the_view_itself():
    assert nearest_views(poses_of([0, 3, 1, 2, -1.5], [0] * 5), 0, 3) == [2, 4, 3]
    assert nearest_views(poses_of([0, 3, 1], [0] * 3), 0, 9) == [2, 1]


def test_views_that_face_elsewhere_or_stand_in_the_same_place_are_left_out():
    poses = poses_of([0, 1, 2, 0, 4], [0, 39, 41, 5, -30])
    assert nearest_views(poses, 0, 9, 40.0) == [1, 4]
    assert nearest_views(poses, 0, 9) == [1, 2, 4], "any direction"
    far = poses.copy()
    far[3, 0, 3] = 1e-5
    assert nearest_views(far, 0, 9) == [3, 1, 2, 4]
    together = poses_of([0, 0, 0], [0] * 3)
    assert nearest_views(together, 0, 9) == [] and nearest_views(together, 1, 9, apart=False) == [0, 2]
