"""Automatic exposure and moving cars and people: what is written down about them is what the images show."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from mmpi_scene import make_scene, render, sfm_points
from mmpi_scene.__main__ import SceneCommand
from mmpi_scene.dataset import light_of, make_exposure
from mmpi_scene.movers import moving_mask, with_movers

FRAMES = {"count": 16, "width": 96, "height": 54, "length": 12.0}


@pytest.fixture(scope="module")
def walk():
    return make_scene("walk", **FRAMES)


@pytest.fixture(scope="module")
def busy(walk):
    return with_movers(walk, 5)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk") / "out"
    SceneCommand("walk", folder, points=50, exposure="auto", moving=5, **FRAMES).main()
    return folder


# Exposure


def test_automatic_gains_vary_three_fold_and_dark_images_get_more(walk):
    scene = make_scene("walk", count=80, width=96, height=54, length=24.0)
    exposure = make_exposure("auto", scene)
    assert exposure is not None
    green = exposure.gains[:, 1]
    assert green.max() / green.min() == pytest.approx(3.0)
    for channel in (0, 2):
        assert 1.04 < (exposure.gains[:, channel] / green).max() <= 1.1 + 1e-9
    light = [light_of(render(scene, i)[0]).mean() for i in range(0, 80, 4)]
    assert np.corrcoef(np.log(light), np.log(green[::4]))[0, 1] < -0.6


def test_the_file_says_how_each_image_was_exposed(written, busy):
    facts = json.loads((written / "exposure.json").read_text())
    meta = json.loads((written / "transforms.json").read_text())
    assert list(facts["gains"]) == [f["file_path"] for f in meta["frames"]]
    x, y = np.meshgrid(np.arange(96) + 0.5 - 48, np.arange(54) + 0.5 - 27)
    passed = 1 - facts["vignetting"] * (x * x + y * y) / (48**2 + 27**2)
    for i in (2, 11):
        name = meta["frames"][i]["file_path"]
        light = light_of(render(busy.filmed_by(i), i)[0])
        exposed = np.minimum(1, np.array(facts["gains"][name]) * passed[..., None] * light) ** (1 / facts["gamma"])
        value = exposed + facts["contrast"] * exposed * (1 - exposed) * (2 * exposed - 1)
        stored = Image.open(written / name)
        assert np.abs(np.asarray(stored) / 255 - value).max() < 0.51 / 255
        seconds = float(stored.getexif().get_ifd(0x8769)[33434])
        assert seconds == pytest.approx(0.01 * facts["gains"][name][1], rel=1e-3)


# Movers


def test_masks_hold_all_that_movers_change_and_little_else(walk, busy):
    changed, masked = 0, 0
    for i in range(16):
        if walk.cameras.is_test[i]:
            continue
        (still, _), (moving, _) = render(walk, i), render(busy.filmed_by(i), i)
        mask, differs = moving_mask(busy, i), np.abs(still - moving).max(-1) > 1.5 / 255
        # A pixel is supersampled where its neighbours differ, so one beside a mover may change a little too.
        wide = np.pad(mask > 0, 1)
        beside = np.any([wide[a : a + 54, b : b + 96] for a in range(3) for b in range(3)], 0)
        assert not (differs & ~beside).any()
        changed, masked = changed + (differs & (mask > 0)).sum(), masked + (mask > 0).sum()
    assert masked > 300 and changed > 0.85 * masked


def test_no_keypoint_lies_on_a_mover(busy):
    actual = sfm_points(busy, 300, noise_pixels=0.0, outliers=0.0)
    for i in np.unique(actual.camera):
        hit = busy.filmed_by(i).hit(*busy.cameras.rays(i, actual.pixel[actual.camera == i]))[1]
        if not busy.cameras.is_test[i]:
            assert not (busy.filmed_by(i).moving[hit] & (hit >= 0)).any()
