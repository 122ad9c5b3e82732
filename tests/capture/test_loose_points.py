"""Points without tracks are seen where nothing of the cloud hides them."""

from __future__ import annotations

import numpy as np

from mmpi_ns.capture.loose_points import with_visible_points
from mmpi_ns.placement.observations import Observations


def looking_ahead(points) -> Observations:
    """A camera at the origin that looks along -z, one that looks back."""
    back = np.diag([-1.0, 1, -1])
    none = np.zeros(0, np.int64)
    return Observations(
        camera_to_worlds=np.stack([np.eye(4)[:3], np.concatenate([back, np.zeros((3, 1))], 1)]),
        intrinsics=np.tile([200.0, 200, 200, 150], (2, 1)),
        sizes=np.tile([400.0, 300], (2, 1)),
        points=np.asarray(points, float),
        seen_by=none,
        seen_point=none,
        seen_at=np.zeros((0, 2)),
    )


def wall(z, x0, x1, step=0.02):
    x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(-0.5, 0.5, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], -1)


def test_a_wall_hides_what_lies_behind_it_and_not_what_lies_beside_it():
    front, hidden, beside = wall(-2.0, -0.6, 0.0), wall(-4.0, -0.8, -0.3), wall(-4.0, 0.4, 1.0)
    observations = with_visible_points(looking_ahead(np.concatenate([front, hidden, beside])))
    assert (observations.seen_by == 0).all()
    found = np.isin(np.arange(len(observations.points)), observations.seen_point)
    parts = np.split(found, [len(front), len(front) + len(hidden)])
    assert parts[0].all() and not parts[1].any() and parts[2].all()


def test_keypoints_are_where_the_points_project_and_each_camera_sees_what_lies_before_it():
    observations = with_visible_points(looking_ahead([[0.1, 0.2, -2], [0.1, 0.2, 2], [50, 0, -2]]))
    assert observations.seen_by.tolist() == [0, 1] and observations.seen_point.tolist() == [0, 1]
    assert np.allclose(observations.seen_at, [[210, 130], [190, 130]])


def test_no_points_no_keypoints():
    observations = with_visible_points(looking_ahead(np.zeros((0, 3))))
    assert not len(observations.seen_by) and not len(observations.seen_at)
