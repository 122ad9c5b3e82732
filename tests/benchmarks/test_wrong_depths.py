"""Depths that are wrong on purpose (benchmarks/wrong_depths.py)."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from wrong_depths import AHEAD, TOO_FAR, write_with_wrong_depths, wrong_distances

from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset
from mmpi_scene.scene import render


@pytest.fixture(scope="module")
def street():
    return make_scene("street", 0, 6, 96, 48, 20.0)


@pytest.fixture(scope="module")
def true(street):
    return render(street, 2)[1]


def changed(kind, street, true, camera=2):
    wrong = wrong_distances(kind, street.cameras, camera, true, 0)
    both = np.isfinite(true) & np.isfinite(wrong)
    return wrong, np.where(both, wrong != true, np.isfinite(true) != np.isfinite(wrong))


def test_scattered_depths_are_a_tenth_and_differ_from_image_to_image(street, true):
    wrong, where = changed("scattered", street, true)
    assert 0.07 < where.mean() < 0.13
    assert (wrong[where] >= 2).all() and (wrong[where] <= 40).all()
    assert not np.array_equal(where, changed("scattered", street, true, camera=3)[1])
    assert np.array_equal(where, changed("scattered", street, true)[1]), "equal seeds, equal depths"


def test_a_mirror_hangs_in_the_same_place_for_all_cameras(street, true):
    wrong, where = changed("mirror", street, true)
    assert 0.02 < where.mean() < 0.4
    assert np.allclose(wrong[where], TOO_FAR * true[where])
    cameras, pixels = street.cameras, np.argwhere(where)[:, ::-1] + 0.5
    origins, directions = cameras.rays(2, pixels)
    points = origins + true[where][:, None] * directions
    other = render(street, 3)[1]
    at, depth = cameras.project(3, points)
    inside = (depth > 0) & (at > 0).all(-1) & (at < [96, 48]).all(-1)
    columns, rows = at[inside].astype(int).T
    seen = np.isclose(other[rows, columns], np.linalg.norm(points[inside] - cameras.camera_to_worlds[3, :, 3], axis=-1),
                      rtol=0.02)  # fmt: skip
    assert seen.sum() > 20
    assert changed("mirror", street, other, camera=3)[1][rows, columns][seen].mean() > 0.9


def test_a_car_has_one_depth_in_every_image(street, true):
    wrong, where = changed("car", street, true)
    height, width = true.shape
    assert 0.02 < where.mean() < 0.1
    x, y = np.meshgrid(np.arange(width) + 0.5 - 48, np.arange(height) + 0.5 - 24)
    depth = wrong / np.sqrt(1 + (x**2 + y**2) / street.cameras.focal**2)
    assert np.allclose(depth[where], AHEAD, rtol=1e-5)


def test_depths_of_test_images_stay_exact(street, tmp_path):
    write_dataset(street, tmp_path / "none", points=50)
    write_with_wrong_depths(street, tmp_path / "mirror", "mirror", points=50)
    meta = json.loads((tmp_path / "none" / "transforms.json").read_text())
    same = {}
    for frame in meta["frames"]:
        pair = [np.asarray(Image.open(tmp_path / name / frame["depth_file_path"])) for name in ("none", "mirror")]
        same[frame["file_path"]] = np.array_equal(*pair)
    assert all(same[path] for path in meta["test_filenames"])
    assert not any(same[path] for path in meta["train_filenames"])
