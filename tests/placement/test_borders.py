"""No holes: what the training images show, and a little beyond, lies in some MPI; also what a fisheye sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_made import observed
from nerfstudio.cameras.cameras import Cameras, CameraType
from procedural import observations_of
from still_life import still_life
from tiny_scene import equidistant

from mmpi_ns.data.rays import lens_directions
from mmpi_ns.placement.observations import find_visible_points
from mmpi_ns.placement.rule import WIDEST, border_points, place, widened
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.settings import PlacementConfig
from mmpi_ns.utils.errors import InputError
from mmpi_scene.catalogue import make_scene


def holds(mpi: MPIPlan, points: np.ndarray) -> np.ndarray:
    local = (points - np.asarray(mpi.origin)) @ np.asarray(mpi.axes).T
    x, y, z = local.T
    u0, u1, v0, v1 = np.add(mpi.extent, [-1e-9, 1e-9, -1e-9, 1e-9])
    return (z >= mpi.near) & (x >= u0 * z) & (x <= u1 * z) & (y >= v0 * z) & (y <= v1 * z)


@pytest.fixture(scope="module")
def scene():
    observations = observations_of(still_life(), per_camera=30)
    return observations, find_visible_points(observations)


@pytest.mark.parametrize("make", [lambda: make_scene("street"), still_life, lambda: make_scene("look-round")])
def test_a_plan_holds_the_borders_of_every_image(make):
    observations = observations_of(make(), per_camera=30)
    plan = place(observations, PlacementConfig())
    points = border_points(observations, find_visible_points(observations))
    assert np.any([holds(m, points) for m in plan.mpis], axis=0).mean() > 0.995


def test_border_points_surround_what_a_camera_sees(scene):
    observations, visible = scene
    each = len(border_points(observations, visible)) // len(observations.centers)
    for i in (0, 5):
        points = border_points(observations, visible)[i * each : (i + 1) * each]
        pose, (fx, fy, cx, cy) = observations.camera_to_worlds[i], observations.intrinsics[i]
        local = (points - pose[:, 3]) @ pose[:, :3]
        depth = -local[:, 2]
        x, y = fx * local[:, 0] / depth + cx, -fy * local[:, 1] / depth + cy
        width, height = observations.sizes[i]
        outside = (x < 0) | (x > width) | (y < 0) | (y > height)
        assert outside.all() and x.min() < -0.04 * width and y.max() > 1.04 * height
        assert np.allclose(np.unique(depth.round(6)), visible.typical[i], rtol=1e-5)


def test_what_would_need_too_wide_a_frustum_is_left_out(scene):
    observations, visible = scene
    (mpi,) = place(observations, PlacementConfig()).mpis
    back = tuple(tuple(-x for x in row) for row in (mpi.axes[0], mpi.axes[2]))
    turned = replace(mpi, axes=(back[0], mpi.axes[1], back[1]))  # looks the other way
    assert widened([turned], observations, visible) == [turned]
    sideways = replace(mpi, axes=(tuple(-x for x in mpi.axes[2]), mpi.axes[1], mpi.axes[0]))
    (got,) = widened([sideways], observations, visible)
    assert np.abs(got.extent).max() <= WIDEST


# Lenses ---------------------------------------------------------------------------------------------------------------

COUNT = 10


def walk(degrees, width=160, height=120):
    """Fisheyes of so many degrees across on a walk through a hall, and points on its walls that each sees."""
    focal = (width / 2) / np.radians(degrees / 2)
    centers = np.stack([np.linspace(0, 1.5, COUNT), 0.1 * np.sin(np.arange(COUNT)), np.zeros(COUNT)], -1)
    poses = np.concatenate([np.tile(np.eye(3), (COUNT, 1, 1)), centers[:, :, None]], -1)
    kind = torch.full((COUNT, 1), CameraType.FISHEYE.value)
    cameras = Cameras(
        torch.from_numpy(poses).float(), focal, focal, width / 2, height / 2, width, height, torch.zeros(6), kind
    )
    rng = np.random.default_rng(0)
    at = rng.uniform([0, 0], [width, height], (COUNT, 300, 2))
    directions = equidistant(((at - [width / 2, height / 2]) / focal * [1, -1]).reshape(-1, 2)).reshape(COUNT, -1, 3)
    reach = np.minimum(3 / np.abs(directions).max(-1, keepdims=True), 9)  # a room of 6 x 6 x 6 about each camera
    points = (centers[:, None] + directions * reach * rng.uniform(0.7, 1, (COUNT, 300, 1))).reshape(-1, 3)
    seen = np.repeat(np.arange(COUNT), 300)
    pinhole, lens = [focal, focal, width / 2, height / 2], lens_directions(cameras)
    return observed(poses, pinhole, [width, height], points, seen, seen_at=at, lens=lens), cameras


def share_in_no_mpi(plan, cameras, distance):
    """Of all pixels of all images, at some distance."""
    lost = []
    for i in range(len(cameras)):
        rays = cameras.generate_rays(camera_indices=i)
        points = (rays.origins + distance * rays.directions).double().reshape(-1, 3).numpy()
        lost.append(1 - np.any([holds(mpi, points) for mpi in plan.mpis], axis=0).mean())
    return np.mean(lost)


def test_directions_are_those_of_the_lens():
    actual, _ = walk(150)
    focal = actual.intrinsics[0, 0]
    shares = np.random.default_rng(1).uniform(0, 1, (200, 2))
    at = (shares - 0.5) * actual.sizes[0] / focal * [1, -1]
    wanted, got = equidistant(at), actual.directions(3, shares)
    assert np.abs(got).max(-1) == pytest.approx(1)
    assert np.abs(got / np.linalg.norm(got, axis=-1, keepdims=True) - wanted).max() < 5e-3
    assert np.abs(actual.depths(np.full(200, 3), actual.centers[3] + 4 * got) - 4).max() < 1e-9
    behind = actual.centers[3] + [[0, 0, 5.0], [1.0, 0, 5.0]]
    assert (actual.depths(np.array([3, 3]), behind) < 0).all()


def test_lenses_without_distortion_are_pinholes():
    focal = torch.full((2, 1), 100.0)
    poses = torch.eye(4)[None, :3].repeat(2, 1, 1)
    assert lens_directions(Cameras(poses, focal, focal, 50.0, 40.0, 100, 80)) is None
    bent = Cameras(poses, focal, focal, 50.0, 40.0, 100, 80, torch.tensor([[-0.1, 0, 0, 0, 0, 0.0]]).repeat(2, 1))
    actual = lens_directions(bent)
    assert actual is not None and np.abs(actual[0, 8, 8] - [0, 0, -1]).max() < 1e-6
    assert actual[0, 8, -1, 0] / -actual[0, 8, -1, 2] > 0.51  # a barrel sees farther than 50 / 100


@pytest.mark.parametrize("degrees", [100, 150, 178])
def test_a_fisheyes_pixels_lie_in_mpis(degrees):
    """At the depths of the room's walls; farther away fewer are lost than if the lens were a pinhole."""
    actual, cameras = walk(degrees)
    assert actual.wide.all() and not walk(80)[0].wide.any()
    plan, pinholes = (place(o, PlacementConfig(max_texels=4e6)) for o in (actual, replace(actual, lens=None)))
    for distance in (3.0, 4.5):
        assert share_in_no_mpi(plan, cameras, distance) < 0.01, (distance, plan.names)
    for distance in (9.0, 1e4):
        lost = share_in_no_mpi(plan, cameras, distance)
        assert lost < 0.5 * share_in_no_mpi(pinholes, cameras, distance), (distance, plan.names)


def test_cameras_that_see_nothing_are_refused():
    """All pixels of a lens look the same way, as those of a panorama of whole turns between the grid's points do."""
    actual, _ = walk(150)
    with pytest.raises(InputError, match="No MPI fits the field of view"):
        place(replace(actual, lens=np.broadcast_to(actual.lens[:, 8:9, 8:9], actual.lens.shape)), PlacementConfig())
