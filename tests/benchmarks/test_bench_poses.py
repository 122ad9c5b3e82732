"""Errors that the bench puts into training poses, and how it measures what is left of them."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from poses import markdown, moved, pose_errors, training_poses
from poses import write_scene as disturb
from tiny_scene import write_scene


@pytest.fixture
def scenes(tmp_path):
    data = write_scene(tmp_path / "data")
    return data, disturb(data, tmp_path / "exact", 0), disturb(data, tmp_path / "off", 1, 2.0, 0.3)


def test_training_poses_are_off_by_what_was_asked_for_and_test_poses_are_exact(scenes):
    data, exact, off = scenes
    a, b = training_poses(exact), training_poses(off)
    assert np.array_equal(a, training_poses(data)) and len(a) == 6
    assert np.linalg.norm((a - b)[:, :3, 3], axis=-1) == pytest.approx(0.3)
    turns = np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]
    assert np.degrees(np.arccos((np.trace(turns, axis1=1, axis2=2) - 1) / 2)) == pytest.approx(2.0)
    before, after = (json.loads((folder / "transforms.json").read_text()) for folder in (data, off))
    assert after["test_filenames"] == before["test_filenames"][:1] and (off / "images").is_dir()
    for x, y in zip(before["frames"], after["frames"], strict=True):
        assert (x == y) == (x["file_path"] not in before["train_filenames"])


@pytest.mark.parametrize("share", [None, 0.0, 0.5, 1.0])
def test_what_a_run_has_mended_is_no_error_any_more(scenes, tmp_path, share):
    """In a run's frame, which is turned and scaled."""
    _, exact, off = scenes
    frame = moved(np.eye(4)[None], np.array([[0.3, -0.2, 0.5, 0.4, 0.1, -0.2]]))[0]
    scale, run = 0.25, tmp_path / "run"
    (run / "nerfstudio_models").mkdir(parents=True)
    told = {"transform": frame[:3].tolist(), "scale": scale}
    (run / "dataparser_transforms.json").write_text(json.dumps(told))
    wanted, given = (frame @ training_poses(s) for s in (exact, off))
    turn = wanted[:, :3, :3] @ np.swapaxes(given[:, :3, :3], 1, 2)
    axis = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1)
    axis *= np.radians(2.0) / np.linalg.norm(axis, axis=-1, keepdims=True)
    moves = np.concatenate([scale * (wanted - given)[:, :3, 3], axis], -1)
    name = "_model.camera_optimizer.pose_adjustment"
    state = {} if share is None else {name: torch.from_numpy((share * moves).astype(np.float32))}
    torch.save({"pipeline": state}, run / "nerfstudio_models" / "step-000000009.ckpt")
    left = 1 - (share or 0.0)
    found = pose_errors(exact, off, run)
    assert found["degrees_off"] == pytest.approx(2.0 * left, abs=2e-3)
    assert found["distance_off"] == pytest.approx(0.3 * left, abs=1e-5)


def test_the_copy_has_the_depth_files_that_its_frames_name(tmp_path):
    data = write_scene(tmp_path / "data")
    meta = json.loads((data / "transforms.json").read_text())
    (data / "depths").mkdir()
    for number, frame in enumerate(meta["frames"]):
        frame["depth_file_path"] = f"depths/{number}.png"
        (data / frame["depth_file_path"]).write_bytes(b"depth")
    (data / "transforms.json").write_text(json.dumps(meta))
    off = disturb(data, tmp_path / "copy", 2, 0.3, 0.05)
    for frame in json.loads((off / "transforms.json").read_text())["frames"]:
        assert (off / frame["depth_file_path"]).read_bytes() == b"depth" and (off / frame["file_path"]).is_file()
    assert not (off / "colmap").exists()


def test_the_page_says_which_figures_have_refined_test_poses():
    numbers = (
        "degrees_off",
        "distance_off",
        "psnr",
        "ssim",
        "refined_psnr",
        "refined_ssim",
        "refined_rotation_degrees",
    )
    made = {
        "command": "python benchmarks/poses.py",
        "processor": "-",
        "threads": 1,
        "torch": "-",
        "commit": "-",
        "date": "-",
    }
    rows = {"given poses, as they are": dict.fromkeys(numbers, 0.5)}
    text = markdown({"made": made, "rows": rows})
    assert "| given poses, as they are | 0.500 | 0.500 | 0.50 | 0.500 | 0.50 | 0.500 | 0.50 |" in text
    assert "no score of new views" in text
