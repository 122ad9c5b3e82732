"""No holes: what the training images show, and a little beyond, lies in some MPI."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from procedural import observations_of
from still_life import still_life

from mmpi_ns.placement.observations import find_visible_points
from mmpi_ns.placement.rule import WIDEST, border_points, place, widened
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.settings import PlacementConfig
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
