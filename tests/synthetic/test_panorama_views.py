"""Equirectangular views of a procedural walk: their rays, against nerfstudio's, and what is written."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from PIL import Image

from mmpi_scene.__main__ import SceneCommand
from mmpi_scene.cameras import Panoramas
from mmpi_scene.catalogue import make_scene


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
