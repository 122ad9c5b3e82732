"""Bad input is refused with one sentence (what, where, what to do), and nothing is lost (docs/errors.md)."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from tiny_scene import HEIGHT, TEST, TRAIN, WIDTH, name_of, write_scene
from training_runs import datamanager, ready, trainer_config

from mmpi_ns.placement.rule import PlacementConfig, place
from mmpi_priors.observe import ENOUGH_KEYPOINTS


@pytest.fixture
def data(tmp_path):
    """A tiny scene to be damaged; it has a COLMAP model."""
    return write_scene(tmp_path / "data")


def edit(data, change):
    """Changes the contents of transforms.json."""
    meta = json.loads((data / "transforms.json").read_text())
    change(meta)
    (data / "transforms.json").write_text(json.dumps(meta))


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
    assert "one place: no distance can be learned" in " ".join(capsys.readouterr().out.split())
    trainer.train()
    assert len(trainer.pipeline.model.field.full_plan.mpis) == 1
    assert all(torch.isfinite(p).all() for p in trainer.pipeline.model.parameters())


def test_without_test_images_training_images_are_scored_and_it_says_so(data, capsys):
    edit(data, keep_one)
    manager = datamanager(data, dataparser=NerfstudioDataParserConfig(auto_scale_poses=False))
    assert manager.eval_dataset.image_filenames == manager.train_dataset.image_filenames
    assert "no test images" in " ".join(capsys.readouterr().out.split())


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


# Crops ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(scene, plan_file, tmp_path_factory):
    """A short run with a checkpoint."""
    trainer = ready(trainer_config(scene, plan_file, tmp_path_factory.mktemp("run"), 6))
    trainer.train()
    return trainer


# Checkpoints ---------------------------------------------------------------------------------------------------------


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_disk_that_is_full_while_saving_leaves_the_last_checkpoint(trained, scene, plan_file, tmp_path):
    trainer = ready(trainer_config(scene, plan_file, tmp_path, 6))
    trainer.config.save_only_latest_checkpoint = True
    trainer.save_checkpoint(2)
    before = contents(trainer.base_dir)
    size = trainer.checkpoint_dir.joinpath("step-000000002.ckpt").stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, limits[1]))  # the real writer fails half way through
    try:
        for step in (2, 3):
            words = (f"step-{step:09d}.ckpt could not be written", "MB free", "make room")
            refusal(lambda step=step: trainer.save_checkpoint(step), *words, error=OSError)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert contents(trainer.base_dir) == before
    again = ready(trainer_config(scene, plan_file, tmp_path / "again", 6), load_dir=trainer.checkpoint_dir)
    assert again._start_step == 3


def test_a_checkpoint_cut_short_is_named(trained, scene, plan_file, tmp_path):
    folder = tmp_path / "models"
    folder.mkdir()
    whole = (trained.checkpoint_dir / "step-000000005.ckpt").read_bytes()
    (folder / "step-000000005.ckpt").write_bytes(whole[: len(whole) // 2])
    config = trainer_config(scene, plan_file, tmp_path / "out", 6)
    refusal(lambda: ready(config, load_dir=folder), folder / "step-000000005.ckpt", "cannot be read", "--load-step")


# Devices, and the command as a whole ---------------------------------------------------------------------------------


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_gpu_asked_for_where_there_is_none(scene, plan_file, tmp_path):
    config = trainer_config(scene, plan_file, tmp_path, 4)
    config.machine.device_type = "cuda"
    refusal(config.save_config, "--machine.device-type cuda", "torch sees none", "--machine.device-type cpu")
    assert not list(tmp_path.iterdir()), "before anything is written"


def test_the_command_ends_with_the_sentence_and_status_1(data, tmp_path):
    edit(data, lambda meta: meta["frames"][3].pop("transform_matrix"))
    done = subprocess.run(
        [str(Path(sys.executable).with_name("ns-train")), "mmpi-small", "--data", str(data), "--output-dir",
         str(tmp_path / "out"), "--machine.device-type", "cpu", "--vis", "tensorboard"],
        capture_output=True, text=True, timeout=200, env=os.environ | {"COLUMNS": "200"},
    )  # fmt: skip
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1 and last.startswith("mmpi_ns.utils.errors.InputError: Frame")
    assert name_of(3) in last and last.endswith("remove the frame.")
