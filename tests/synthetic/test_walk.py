"""The hand-held walk: its lens against OpenCV's and nerfstudio's, and what a 360-degree camera sees there."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from PIL import Image

from mmpi_scene import make_scene, sfm_points, write_dataset
from mmpi_scene.__main__ import SceneCommand
from mmpi_scene.cameras import Panoramas


@pytest.fixture(scope="module")
def walk():
    return make_scene("walk", count=12, width=96, height=54, length=6.0)


@pytest.fixture(scope="module")
def folder(walk, tmp_path_factory):
    path = tmp_path_factory.mktemp("walk") / "out"
    write_dataset(walk, path, points=300, noise_pixels=0.0, outliers=0.0)
    return path


def test_the_lens_is_opencvs(walk):
    cameras, pose = walk.cameras, walk.cameras.camera_to_worlds[3]
    local = np.random.default_rng(0).uniform([-0.6, -0.35, -1.0], [0.6, 0.35, -1.0], (200, 3)) * 7.0
    matrix = np.array([[cameras.focal, 0, 48], [0, cameras.focal, 27], [0, 0, 1]])
    at = cv2.projectPoints(local * [1, -1, -1], np.zeros(3), np.zeros(3), matrix, np.array(cameras.distortion))[0][:, 0]
    pixels, depths = cameras.project(3, local @ pose[:, :3].T + pose[:, 3])
    assert np.allclose(pixels, at, atol=1e-9) and np.allclose(depths, 7.0)
    pinhole = local[:, :2] / 7.0 * [1, -1] * cameras.focal + [48, 27]
    assert 1.0 < np.abs(pixels - pinhole).max() < 6.0


def test_rays_go_where_pixels_come_from(walk):
    pixels = np.random.default_rng(1).uniform(0, [96, 54], (500, 2))
    origins, directions = walk.cameras.rays(5, pixels)
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-14)
    assert np.abs(walk.cameras.project(5, origins + 12.0 * directions)[0] - pixels).max() < 1e-10


def test_nerfstudio_reads_the_lens_and_draws_the_same_rays(walk, folder):
    from training_runs import datamanager

    outputs = datamanager(folder).train_dataparser_outputs
    cameras = outputs.cameras
    assert torch.allclose(cameras.distortion_params[0], torch.tensor([-0.11, 0.045, 0, 0, 0.0012, -0.0008]))
    transform = outputs.dataparser_transform.double().numpy()
    number = np.flatnonzero(~walk.cameras.is_test)
    pixels = np.random.default_rng(2).integers(0, [96, 54], (40, 2)) + 0.5
    coords = torch.tensor(pixels[:, ::-1].copy(), dtype=torch.float32)
    for i in (0, 4):
        index = torch.full((40, 1), i)
        rays = cameras.generate_rays(camera_indices=index, coords=coords).directions.numpy()
        assert np.abs(rays - walk.cameras.rays(number[i], pixels)[1] @ transform[:, :3].T).max() < 2e-5


def test_points_and_depths_agree_with_the_lens(walk, folder):
    import pycolmap

    actual = sfm_points(walk, 100, noise_pixels=0.0, outliers=0.0)
    off = walk.cameras.project(actual.camera, actual.points[actual.point])[0] - actual.pixel
    assert np.abs(actual.points - actual.true_points).max() < 1e-6 and np.linalg.norm(off, axis=-1).max() < 1e-6
    model = pycolmap.Reconstruction(str(folder / "colmap/sparse/0"))
    assert model.cameras[1].model.name == "OPENCV" and max(p.error for p in model.points3D.values()) < 1e-4
    meta = json.loads((folder / "transforms.json").read_text())
    millimetres = cv2.imread(str(folder / meta["frames"][2]["depth_file_path"]), cv2.IMREAD_UNCHANGED).astype(float)
    points, seen = actual.true_points[actual.point], actual.camera == 2
    pixels, depths = walk.cameras.project(2, points[seen])
    stored = millimetres[tuple(pixels.astype(int).T[::-1])] / 1000
    assert seen.sum() > 20 and np.median(np.abs(stored / depths - 1)) < 0.02


# Panoramas


def test_pixels_see_ahead_to_the_right_and_up():
    cameras = Panoramas.of(make_scene("walk", count=3, width=81).cameras)
    assert (cameras.width, cameras.height, len(cameras)) == (80, 40, 3)
    pose = cameras.camera_to_worlds[1]
    origins, directions = cameras.rays(1, np.array([[40.0, 20.0], [60.0, 20.0], [40.0, 0.0], [0.0, 20.0], [7.0, 40.0]]))
    right, up, back = pose[:, :3].T
    assert np.allclose(directions, [-back, right, up, back, -up], atol=1e-12)
    assert np.array_equal(origins, np.tile(pose[:, 3], (5, 1)))


def test_nerfstudio_draws_the_same_rays_and_only_panoramas_are_written(tmp_path):
    SceneCommand("walk", tmp_path / "scene", panorama=True, width=32, count=2, length=1.0).main()
    meta = json.loads((tmp_path / "scene/transforms.json").read_text())
    assert meta["camera_model"] == "EQUIRECTANGULAR"
    poses = np.array([f["transform_matrix"] for f in meta["frames"]])
    ours = Panoramas(poses[:, :3], 32 / (2 * np.pi), 32, 16, 8)
    theirs = Cameras(
        torch.tensor(poses[:, :3], dtype=torch.float32), meta["fl_x"], meta["fl_y"], meta["cx"], meta["cy"],
        meta["w"], meta["h"], camera_type=CameraType.EQUIRECTANGULAR,
    )  # fmt: skip
    rays = theirs.generate_rays(camera_indices=1).directions.reshape(-1, 3).numpy()
    assert np.abs(rays - ours.rays(1, ours.pixel_centers)[1]).max() < 1e-5
    assert Image.open(tmp_path / "scene" / meta["frames"][1]["file_path"]).size == (32, 16)
    assert sorted(p.name for p in (tmp_path / "scene").iterdir()) == ["images", "transforms.json"]


def test_a_height_is_refused_with_panoramas(tmp_path):
    with pytest.raises(ValueError, match="half as high as wide: leave --height out"):
        SceneCommand("walk", tmp_path / "scene", panorama=True, width=32, height=16, count=2).main()
