"""Bad input is refused with one sentence (what, where, what to do), and nothing is lost."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from tiny_scene import HEIGHT, TEST, TRAIN, WIDTH, edit, name_of, write_scene
from training_runs import datamanager, ready, trainer_config

from mmpi_ns.placement.rule import place
from mmpi_ns.settings import PlacementConfig
from mmpi_priors.observe import ENOUGH_KEYPOINTS


@pytest.fixture
def data(tmp_path):
    """A tiny scene to be damaged; it has a COLMAP model."""
    return write_scene(tmp_path / "data")


def refusal(action, *words, error=ValueError):
    """The sentence with which an action is refused; it must hold these words."""
    with pytest.raises(error) as caught:
        action()
    message = str(caught.value)
    assert all(str(w) in message for w in words), message
    assert "\n" not in message and ". " not in message and message.endswith("."), message


def stand_still(meta):
    for frame in meta["frames"]:
        frame["transform_matrix"] = meta["frames"][0]["transform_matrix"]


def keep_one(meta):
    for key in ("train", "val", "test"):
        del meta[f"{key}_filenames"]
    meta["frames"] = meta["frames"][:1]


# The capture ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [stand_still, keep_one])
def test_one_place_can_be_trained_on_request_and_says_what_it_cannot_learn(data, tmp_path, capsys, change):
    edit(data, change)
    shutil.rmtree(data / "colmap")
    config = trainer_config(data, None, tmp_path, 4, training="joint")
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(auto_scale_poses=False)
    trainer = ready(config)
    assert "have the same position: depths cannot be learned" in " ".join(capsys.readouterr().out.split())
    trainer.train()
    assert len(trainer.pipeline.model.field.full_plan.mpis) == 1
    assert all(torch.isfinite(p).all() for p in trainer.pipeline.model.parameters())


# Images and masks ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("i", [TRAIN[2], TEST[1]])
@pytest.mark.parametrize("damage", ["size", "channels", "missing"])
def test_a_mask_that_does_not_fit_is_named(tmp_path, i, damage):
    data = write_scene(tmp_path / "masked", masks=True)
    path = data / "masks" / name_of(i)
    shape = {"size": (HEIGHT // 2, WIDTH), "channels": (HEIGHT, WIDTH, 3)}.get(damage)
    if shape is None:
        path.unlink()
    else:
        Image.fromarray(np.full(shape, 255, np.uint8)).save(path)
    refusal(lambda: datamanager(data), path, "cannot be used", "one channel of the image's size")


@pytest.mark.parametrize("kind", ["palette", "16 bits", "1 bit", "0 and 1"])
def test_masks_of_other_kinds_hide_the_same_half(tmp_path, kind):
    data = write_scene(tmp_path / "masked", masks=True)
    for i in range(8):
        path = data / "masks" / name_of(i)
        with Image.open(path) as image:
            shades = np.array(image)
        if kind == "palette":  # whose first colour is white
            mask = Image.fromarray((shades == 0).astype(np.uint8), "P")
            mask.putpalette([255, 255, 255, 0, 0, 0])
        else:
            numbers = {"16 bits": shades.astype(np.uint16) * 257, "1 bit": shades > 0, "0 and 1": shades // 255}
            mask = Image.fromarray(numbers[kind])
        mask.save(path)
    usable = datamanager(data).train_dataset.usable(0)
    assert usable[:, : WIDTH // 2].all() and not usable[:, WIDTH // 2 :].any()


# Points --------------------------------------------------------------------------------------------------------------


def move_points(data, move):
    """Moves the points of the COLMAP model, and leaves the keypoints."""
    path = data / "colmap/sparse/0/points3D.txt"
    rows = [line.split() for line in path.read_text().splitlines()]
    moved = [[r[0], *(str(v) for v in move(n, np.array(r[1:4], float))), *r[4:]] for n, r in enumerate(rows)]
    path.write_text("\n".join(" ".join(r) for r in moved) + "\n")


def test_a_scene_without_points_says_how_it_finds_some(tmp_path, capsys):
    manager = datamanager(write_scene(tmp_path / "bare", sfm=False))
    said = " ".join(capsys.readouterr().out.split())
    assert "No SfM tracks: matching the features" in said and "a quick search for surfaces locates" in said
    assert len(place(manager.observations, PlacementConfig()).mpis) >= 1


def test_a_model_whose_points_are_all_behind_the_cameras_is_not_used(data, capsys):
    move_points(data, lambda n, p: p * [1, 1, -1])
    observations = datamanager(data, test_mode="test").observations
    assert "does not fit the cameras" in capsys.readouterr().out
    assert not len(observations.seen_at)


def test_placement_refuses_points_behind_every_camera(scene):
    observations = datamanager(scene).observations
    turned = replace(observations, camera_to_worlds=observations.camera_to_worlds * np.array([-1, 1, -1, 1]))
    refusal(lambda: place(turned, PlacementConfig()), "in front", "check the poses")
    assert len(observations.seen_by) > ENOUGH_KEYPOINTS


# Devices, and the command as a whole ---------------------------------------------------------------------------------


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_gpu_asked_for_where_there_is_none(scene, plan_file, tmp_path):
    config = trainer_config(scene, plan_file, tmp_path, 4)
    config.machine.device_type = "cuda"
    refusal(config.save_config, "--machine.device-type cuda", "torch sees none", "--machine.device-type cpu")
    assert not list(tmp_path.iterdir()), "before anything is written"
