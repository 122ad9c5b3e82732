"""The hand-held walk: its lens against OpenCV's and nerfstudio's, its path, and images written side by side."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch
from procedural import keypoint_errors

from mmpi_scene import make_scene, sfm_points, write_dataset


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


def test_what_lies_beyond_the_corners_is_seen_outside_the_image(walk):
    pose, size = walk.cameras.camera_to_worlds[0], np.array([96, 54])
    for tangent in (0.9, 1.5, 3.0, 10.0):
        angle = np.linspace(0, 2 * np.pi, 50)
        local = np.stack([tangent * np.cos(angle), tangent * np.sin(angle), -np.ones(50)], -1)
        pixels = walk.cameras.project(0, local @ pose[:, :3].T + pose[:, 3])[0]
        assert ((pixels < 0) | (pixels > size)).any(-1).all()


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

    found = sfm_points(walk, 100, noise_pixels=0.0, outliers=0.0)
    assert np.abs(found.points - found.true_points).max() < 1e-6 and keypoint_errors(walk, found).max() < 1e-6
    model = pycolmap.Reconstruction(str(folder / "colmap/sparse/0"))
    assert model.cameras[1].model.name == "OPENCV" and max(p.error for p in model.points3D.values()) < 1e-4
    meta = json.loads((folder / "transforms.json").read_text())
    millimetres = cv2.imread(str(folder / meta["frames"][2]["depth_file_path"]), cv2.IMREAD_UNCHANGED).astype(float)
    points, seen = found.true_points[found.point], found.camera == 2
    pixels, depths = walk.cameras.project(2, points[seen])
    stored = millimetres[tuple(pixels.astype(int).T[::-1])] / 1000
    assert seen.sum() > 20 and np.median(np.abs(stored / depths - 1)) < 0.02


def test_the_walk_shakes_turns_and_stays_on_the_carriageway():
    scene = make_scene("walk", count=300, width=96, height=54, length=60.0)
    poses = scene.cameras.camera_to_worlds
    facing = -poses[:, :, 2]
    step = np.degrees(np.arccos(np.clip((facing[1:] * facing[:-1]).sum(-1), -1, 1)))
    assert 0.3 < np.median(step) < 3.0 and step.max() < 6.0
    yaw = np.degrees(np.unwrap(np.arctan2(facing[:, 1], facing[:, 0])))
    assert np.ptp(yaw) > 60 and 0.2 < np.degrees(np.abs(poses[:, 2, 0]).mean()) < 2.0
    assert np.ptp(poses[:, 2, 3]) < 0.2
    around = np.stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8), np.zeros(16)], -1)
    nearest = [scene.hit(np.broadcast_to(p, (16, 3)), around)[0].min() for p in poses[::5, :, 3]]
    assert min(nearest) > 0.3


def test_several_processes_write_the_same_files(walk, folder, tmp_path):
    write_dataset(walk, tmp_path / "out", points=300, noise_pixels=0.0, outliers=0.0, processes=3)
    files = sorted(p.relative_to(folder) for p in folder.rglob("*.png"))
    assert len(files) == 24 and all((folder / f).read_bytes() == (tmp_path / "out" / f).read_bytes() for f in files)


def test_an_image_that_cannot_be_written_ends_all_processes(walk, tmp_path, monkeypatch):
    from mmpi_scene import dataset

    monkeypatch.setattr(dataset, "image_name", lambda camera: f"{camera}.nothing" if camera == 3 else f"{camera}.png")
    with pytest.raises(ValueError, match="unknown file extension"):
        write_dataset(walk, tmp_path / "out", points=0, tracks=False, processes=2)
    assert not (tmp_path / "out" / "transforms.json").exists()
