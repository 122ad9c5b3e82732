"""A point cloud beside the images becomes depths of pixels and keypoints, unless the images contradict it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from tiny_scene import wall_points, write_scene
from training_runs import datamanager

from mmpi_ns.data.checks import log_once


def scene_with_points(folder, points, sfm=False):
    """The tiny scene, without a COLMAP model unless asked for, with these points in ``ply_file_path``."""
    data = write_scene(folder, sfm=sfm)
    if points is not None:
        head = "".join(f"property float {name}\n" for name in "xyz")
        rows = "".join(f"{x} {y} {z}\n" for x, y, z in points)
        (data / "cloud.ply").write_text(
            f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{head}end_header\n{rows}"
        )
        meta = json.loads((data / "transforms.json").read_text()) | {"ply_file_path": "cloud.ply"}
        (data / "transforms.json").write_text(json.dumps(meta))
    return data


@pytest.fixture(scope="module")
def without(tmp_path_factory):
    return datamanager(scene_with_points(tmp_path_factory.mktemp("bare") / "scene", None))


def codes(manager):
    return np.stack(manager.priors.depths.codes)


def test_points_of_a_cloud_are_depths_of_pixels_and_keypoints(without, tmp_path, capsys):
    manager = datamanager(scene_with_points(tmp_path / "scene", wall_points()))
    assert "Point cloud: 45 of 45 points are seen" in capsys.readouterr().out
    seen = manager.observations
    assert len(seen.seen_at) > 45 and not len(without.observations.seen_at)
    tracked = slice(len(seen.seen_at))
    columns, rows = seen.seen_at.astype(int).T
    distance = np.linalg.norm(seen.points[seen.seen_point[tracked]] - seen.centers[seen.seen_by[tracked]], axis=-1)
    stored = np.stack([manager.priors.depths.image(i) for i in range(6)])[seen.seen_by[tracked], rows, columns, 0]
    assert (np.abs(stored * distance - 1) < 0.05).all()  # two points may share a pixel: the nearer stays
    assert manager.priors.depths.share > without.priors.depths.share
    placed, cells = (m.priors.placement for m in (manager, without))
    assert len(placed.seen_by) > len(cells.seen_by)


@pytest.mark.parametrize("scale", [0.5, 1e6])
def test_a_cloud_that_the_images_contradict_changes_nothing(without, tmp_path, capsys, scale):
    manager = datamanager(scene_with_points(tmp_path / "scene", scale * wall_points()))
    said = " ".join(capsys.readouterr().out.split())
    assert ("does not fit the images" if scale < 1 else "45 of 45 points of the point cloud are not used") in said
    assert np.array_equal(codes(manager), codes(without))
    assert len(manager.observations.points) == len(without.observations.points)


def test_a_cloud_gives_depths_where_images_are_not_matched(tmp_path):
    data = scene_with_points(tmp_path / "scene", wall_points())
    manager = datamanager(data, dense_depth=False, depth_images=False)
    assert manager.priors.depths is not None and manager.priors.depths.share > 0.03
    manager.config.dataparser.load_3D_points = False
    assert manager.config.setup(device="cpu", test_mode="val").priors.depths is None


def test_a_cloud_beside_tracks_is_said_to_be_unused_and_no_more(tmp_path, capsys):
    """Also where single points are absurd, as in the cloud of a COLMAP model."""
    log_once.cache_clear()
    data = scene_with_points(tmp_path / "scene", np.vstack([wall_points(), [[1e30, 0, 0]]]), sfm=True)
    assert datamanager(data).observations.loose is None
    said = " ".join(capsys.readouterr().out.split())
    assert "Point cloud: not used, because the SfM tracks" in said and "points of the point cloud" not in said
