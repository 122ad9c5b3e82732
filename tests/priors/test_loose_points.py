"""Points without tracks are seen where matches confirm them; elsewhere, where nothing of the cloud hides them."""

from __future__ import annotations

import numpy as np
import pytest
from hand_made import observed, posed

from mmpi_ns.data.posed_images import PosedImages
from mmpi_priors.clouds import read_ply, see_points

PINHOLE, SIZE = [200, 200, 200, 150], [400, 300]


def cameras(*poses, lens=(0.0, 0, 0, 0)) -> PosedImages:
    return posed(poses, PINHOLE, SIZE, lens=lens)


AHEAD = np.eye(4)[:3]
BOTH = cameras(AHEAD, AHEAD * [[-1], [1], [-1]])


def wall(z, x0, x1, step=0.02):
    x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(-0.5, 0.5, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], -1)


def test_points_keep_all_their_digits(tmp_path):
    head = ["ply", "format ascii 1.0", "element vertex 2", *(f"property double {c}" for c in "xyz"), "end_header", ""]
    path = tmp_path / "map.ply"
    path.write_text("\n".join(head) + "455000.123456789 5411000.25 -1\n0 0 0\n")
    np.testing.assert_array_equal(read_ply(path), [[455000.123456789, 5411000.25, -1], [0, 0, 0]])


def test_a_wall_hides_what_lies_behind_it_and_not_what_lies_beside_it():
    front, hidden, beside = wall(-2.0, -0.6, 0.0), wall(-4.0, -0.8, -0.3), wall(-4.0, 0.4, 1.0)
    seen = see_points(np.concatenate([front, hidden, beside]), BOTH)
    assert (seen.seen_by == 0).all()
    visible = np.isin(np.arange(len(seen.points)), seen.seen_point)
    parts = np.split(visible, [len(front), len(front) + len(hidden)])
    assert parts[0].all() and not parts[1].any() and parts[2].all()


def test_keypoints_are_where_the_points_project_and_each_camera_sees_what_lies_before_it():
    seen = see_points(np.array([[0.1, 0.2, -2], [0.1, 0.2, 2], [50, 0, -2]]), BOTH)
    assert seen.seen_by.tolist() == [0, 1] and seen.seen_point.tolist() == [0, 1]
    assert np.allclose(seen.seen_at, [[210, 130], [190, 130]])


def test_keypoints_are_bent_by_the_lens_and_what_it_cannot_show_is_not_seen():
    lens = (-0.3, 0.0, 0.0, 0.0)
    seen = see_points(np.array([[0.6, 0.3, -2], [3.2, 0, -2]]), cameras(AHEAD, lens=lens))
    assert seen.seen_point.tolist() == [0]  # the second, at tangent 1.6, would be bent back to 0.37
    bend = 1 - 0.3 * (0.3**2 + 0.15**2)
    assert np.allclose(seen.seen_at, [[200 + 200 * 0.3 * bend, 150 - 200 * 0.15 * bend]])


def flat_depth(distance, error=0.01):
    """Known depths of an image that shows a sphere about the camera; nothing is known in its right half."""
    image = np.zeros((300, 400, 2), np.float32)
    image[:, :200] = np.array([1, error]) / distance
    return lambda i: image


def test_matches_confirm_hide_and_contradict_points():
    at, behind, through, unknown = [-1, 0, -2], [-2, 0, -4], [-0.5, 0, -1], [0.5, 0, -1]
    near = float(np.linalg.norm(at))
    seen = see_points(np.array([at, behind, through, unknown]), cameras(AHEAD), flat_depth(near))
    assert seen.confirmed.tolist() == [1, 0, 0, 0] and seen.contradicted.tolist() == [0, 0, 1, 0]
    assert seen.seen_point.tolist() == [0, 3]


def test_a_point_that_the_cloud_would_hide_is_seen_where_matches_confirm_it():
    post, ground = [-1.0, 0.0, -2.0], wall(-3.0, -2.0, -1.0)
    seen = see_points(np.concatenate([[post], ground]), cameras(AHEAD), flat_depth(3.6, error=0.03))
    assert not np.isin(0, seen.seen_point) and len(seen.seen_point) > 0.8 * len(ground)
    assert not np.isin(1 + np.arange(len(ground)), see_points(seen.points, cameras(AHEAD)).seen_point).all()


def test_sightings_come_after_the_tracks_and_before_searched_points_without_contradicted_ones():
    points = np.array([[-0.5, 0, -1.0], [0.5, 0, -1], [0.6, 0.1, -1]])
    seen = see_points(points, cameras(AHEAD, AHEAD), flat_depth(3.0))
    assert seen.contradicted.tolist() == [2, 0, 0]
    poses, nothing = BOTH.camera_to_worlds, np.zeros((1, 3))
    before = observed(poses, PINHOLE, SIZE, np.full((4, 3), 9.0), [0] * 4, seen_at=[[5, 5]] * 2, loose=nothing)
    joined = seen.added_to(before)
    assert len(joined.points) == 7 and joined.loose is None
    assert joined.seen_point.tolist() == [0, 1, 5, 6, 5, 6, 2, 3]
    assert joined.seen_by.tolist() == [0, 0, 0, 0, 1, 1, 0, 0]
    assert len(joined.seen_at) == 6 and np.allclose(joined.seen_at[2], [300, 150])


@pytest.mark.parametrize(("scale", "fits"), [(1.0, True), (0.4, False)])
def test_a_cloud_in_another_unit_does_not_fit(scale, fits):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3)) * [0.3, 0.3, 0] - [0.4, 0, 1]
    points = 3 * scale * directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    seen = see_points(points, cameras(AHEAD), flat_depth(3.0))
    assert seen.fits == fits
    assert ("does not fit the images" in seen.describe()) != fits
    assert see_points(points, cameras(AHEAD)).fits
