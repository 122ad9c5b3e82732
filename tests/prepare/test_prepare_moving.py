"""mmpi-prepare masks the cars of a short drive with known poses."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from mmpi_prepare.pipeline import prepare
from mmpi_prepare.settings import Settings
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset
from mmpi_scene.movers import MOVER, with_movers


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    write_dataset(with_movers(make_scene("street", 0, 16, 320, 180, 13.0), 2), folder, tracks=False)
    return folder


def prepared(drive, scene, **settings):
    prepare(Settings(drive / "images", scene, poses=drive / "transforms.json", threads=1, downscales=(2,), **settings))
    return json.loads((scene / "transforms.json").read_text())


def test_what_moves_in_training_images_is_masked_and_shown(drive, tmp_path):
    meta = prepared(drive, tmp_path / "scene")
    moving, static = [], []
    for frame in meta["frames"]:
        mask = cv2.imread(str(tmp_path / "scene" / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(mask)) <= {0, 255}
        truth = cv2.imread(str(drive / "moving" / frame["file_path"].rpartition("/")[2]), cv2.IMREAD_UNCHANGED)
        if frame["file_path"] in meta["test_filenames"]:
            assert mask.all()
        else:
            moving.append(mask[truth == MOVER] == 0)
            static.append(mask[truth == 0] == 0)
    assert np.concatenate(moving).mean() > 0.4 and np.concatenate(static).mean() < 0.02
    assert (tmp_path / "scene/masks_2").is_dir() and (tmp_path / "scene/report/moving.jpg").is_file()
    report = (tmp_path / "scene/report.md").read_text()
    assert "of the training pixels" in report and "report/moving.jpg" in report


def test_what_moves_is_kept_where_that_is_asked_for(drive, tmp_path):
    meta = prepared(drive, tmp_path / "scene", moving="keep")
    assert not any("mask_path" in frame for frame in meta["frames"]) and not (tmp_path / "scene/masks").exists()
