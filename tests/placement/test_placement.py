"""Placement: expected pixel errors and the choice of MPIs."""

from __future__ import annotations

from dataclasses import replace

import hand_made
import numpy as np
import pytest
from hand_made import median_reprojection_error

from mmpi_ns.placement.errors import mpi_errors
from mmpi_ns.placement.observations import Observations, find_visible_points, pixels_per_pixel
from mmpi_ns.placement.rule import place, texel_limits
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.settings import PlacementConfig

FOCAL, WIDTH, HEIGHT = 180.0, 310.0, 94.0
OPENGL = np.diag([1.0, -1.0, -1.0])  # camera axes of a camera that looks along +z with y down


def cameras(centers: np.ndarray, axes: np.ndarray = OPENGL) -> np.ndarray:
    return np.stack([np.concatenate([axes, c[:, None]], 1) for c in centers])


def observed(centers: np.ndarray, points: np.ndarray, axes: np.ndarray = OPENGL) -> Observations:
    """Cameras that see every point in front of them that falls into their image."""
    poses = cameras(centers, axes)
    seen_by, seen_point, seen_at = [], [], []
    for i, pose in enumerate(poses):
        local = (points - pose[:, 3]) @ pose[:, :3]
        x = WIDTH / 2 - FOCAL * local[:, 0] / local[:, 2]
        y = HEIGHT / 2 + FOCAL * local[:, 1] / local[:, 2]
        index = np.nonzero((local[:, 2] < -0.5) & (x > 0) & (x < WIDTH) & (y > 0) & (y < HEIGHT))[0]
        seen_by.append(np.full(len(index), i))
        seen_point.append(index)
        seen_at.append(np.stack([x, y], -1)[index])
    seen = (np.concatenate(x) for x in (seen_by, seen_point, seen_at))
    return hand_made.observed(poses, [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], [WIDTH, HEIGHT], points, *seen)


def street(count: int = 21, length: float = 40.0) -> Observations:
    rng = np.random.default_rng(0)
    side = rng.choice([-6.0, 6.0], 3000)
    points = np.stack([side, rng.uniform(-6, 1.6, 3000), rng.uniform(2, length + 80, 3000)], -1)
    centers = np.stack([np.zeros(count), np.zeros(count), np.linspace(0, length, count)], -1)
    return observed(centers, points)


def front(near: float = 3.0) -> MPIPlan:
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return MPIPlan("front", (0.0, 0.0, 0.0), axes, near, (-1.0, 1.0, -0.4, 0.4), 64, 96, 256)


@pytest.mark.parametrize(("b_perp", "b_z"), [(0.0, 5.0), (0.3, 0.0), (0.5, 7.0), (-0.4, -3.0)])
def test_errors_of_a_parallel_camera_follow_the_documented_formulas(b_perp, b_z):
    depth, tangent = 20.0, 0.3
    point = np.array([[tangent * depth, 0.0, depth]])
    observations = observed(np.array([[b_perp, 0.0, b_z]]), np.array([[0.0, 0.0, 30.0]]))
    mpi = replace(front(), height=1000)
    plane, texel = mpi_errors(mpi, observations, np.array([0]), point)
    step = 1 / (mpi.near * (mpi.planes - 1))
    stretch = depth / (depth - b_z)
    assert plane[0] == pytest.approx(0.5 * FOCAL * abs(b_perp - tangent * b_z) * step * stretch**2, rel=1e-9)
    assert texel[0] == pytest.approx(FOCAL * 2.0 / (mpi.width - 1) * stretch, rel=1e-9)


def test_errors_of_a_turned_camera_equal_the_projected_displacement():
    angle = 0.3
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    observations = observed(np.array([[0.4, 0.1, 2.0]]), np.array([[0.0, 0.0, 30.0]]), turn @ OPENGL)
    mpi, point = front(), np.array([2.0, -1.0, 15.0])
    pose = observations.camera_to_worlds[0]

    def project(w: float) -> np.ndarray:
        local = (np.array([point[0] / point[2], point[1] / point[2], 1]) / w - pose[:, 3]) @ pose[:, :3]
        return FOCAL * local[:2] / local[2]

    step, w = 1 / (mpi.near * (mpi.planes - 1)), 1 / point[2]
    tiny = 1e-4 * step
    slope = np.linalg.norm(project(w + tiny) - project(w - tiny)) / (2 * tiny)
    plane, _ = mpi_errors(mpi, observations, np.array([0]), point[None])
    assert plane[0] == pytest.approx(0.5 * step * slope, rel=1e-5)


def test_texels_are_no_finer_than_the_rays_of_a_run_can_train():
    observations = street()
    pixels = int(observations.sizes.prod(-1).sum())
    config = PlacementConfig(max_texels=0)
    fine, enough, short = (place(observations, config, rays) for rays in (None, 10 * pixels, pixels // 10))
    assert [m.width for m in enough.mpis] == [m.width for m in fine.mpis]
    tangents = short.mpis[0].extent[1] - short.mpis[0].extent[0]
    spans = tangents * FOCAL / (short.mpis[0].width - 1)
    tangent = WindowedPlan.single(short).texel_tangent
    assert observations.focal == FOCAL and tangent * FOCAL == pytest.approx(spans, rel=0.05), "of rows or columns"
    visible = find_visible_points(observations)
    # Five rays for the footprint of a texel, where every pixel has a tenth of a ray and several images see the same.
    sharing = pixels_per_pixel(observations, visible)
    assert 3 < sharing < len(observations.centers)
    trainable, _ = texel_limits(observations, visible, config, pixels // 10)
    assert trainable == pytest.approx((5 / (0.1 * sharing)) ** 0.5, rel=0.02) and spans >= trainable
    assert f"a texel spans {spans:.1f} pixels: finer with more steps" in short.origin_of_plan


def test_a_drive_looks_along_its_path_and_a_walk_round_an_object_does_not():
    drive, count = street(), 12
    assert drive.looks_along_path
    shuffled = np.random.default_rng(0).permutation(len(drive.centers))
    assert replace(drive, camera_to_worlds=drive.camera_to_worlds[shuffled]).looks_along_path, "in any order"
    sideways = drive.camera_to_worlds.copy()
    sideways[:, :, [0, 2]] = sideways[:, :, [2, 0]] * [1, -1]
    assert not replace(drive, camera_to_worlds=sideways).looks_along_path
    rig = np.repeat(drive.camera_to_worlds, 2, 0)  # two cameras in each place
    assert replace(drive, camera_to_worlds=rig, intrinsics=np.repeat(drive.intrinsics, 2, 0)).looks_along_path
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    poses = np.zeros((count, 3, 4))
    poses[:, 1, 1] = 1
    poses[:, :, 2] = poses[:, :, 3] = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    poses[:, :, 0] = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], -1)
    assert not replace(drive, camera_to_worlds=poses).looks_along_path
    assert not replace(drive, camera_to_worlds=drive.camera_to_worlds[:1]).looks_along_path


def test_points_that_are_not_finite_or_behind_their_camera_are_left_out():
    observations = street()
    points = observations.points.copy()
    points[:100] = np.nan
    points[100:200, 2] = -50
    plan = place(replace(observations, points=points), PlacementConfig())
    assert np.isfinite([m.near for m in plan.mpis]).all()


def test_no_point_in_front_of_any_camera_is_an_error():
    observations = street()
    with pytest.raises(ValueError, match="in front of the camera"):
        place(replace(observations, points=-observations.points - 1000), PlacementConfig())


def test_without_points_the_cameras_frusta_stand_in():
    observations = street()
    empty = np.zeros(0, np.int64)
    bare = replace(observations, points=np.zeros((0, 3)), seen_by=empty, seen_point=empty, seen_at=np.zeros((0, 2)))
    plan = place(bare, PlacementConfig())
    assert plan.mpis and plan.content_near > 0


def test_points_project_to_where_they_were_seen_and_behind_the_camera_to_nowhere():
    observations = street()
    seen, points = observations.seen_by, observations.points[observations.seen_point]
    pixels, ahead = observations.project(seen, points)
    assert ahead.all()
    np.testing.assert_allclose(pixels, observations.seen_at, atol=1e-6)
    assert median_reprojection_error(observations) < 1e-9
    behind = 2 * observations.centers[seen] - points
    assert not observations.project(seen, behind)[1].any()
