"""The real commands on the tiny scene, from training to a cropped picture."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import torch
from forked import start
from PIL import Image
from tiny_scene import FOCAL, HEIGHT, TEST, TRAIN, WIDTH, image_of
from training_runs import datamanager

pytestmark = pytest.mark.commands

STEPS, SAVED = 60, 20
METHODS = sorted(e.name for e in entry_points(group="nerfstudio.method_configs") if e.value.startswith("mmpi_ns."))
FOV = float(np.degrees(2 * np.arctan(HEIGHT / 2 / FOCAL)))


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """Runs an installed command to its end: no network, one thread, and something called ffmpeg to satisfy a check."""
    folder = tmp_path_factory.mktemp("bin")
    if shutil.which("ffmpeg") is None:  # pictures need no encoder, but ns-render insists on one
        (folder / "ffmpeg").write_text("#!/bin/sh\nexit 1\n")
        (folder / "ffmpeg").chmod(0o755)
    nowhere = "http://127.0.0.1:9"
    env = os.environ | {
        "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1", "COLUMNS": "200",
        "HTTPS_PROXY": nowhere, "HTTP_PROXY": nowhere, "https_proxy": nowhere, "http_proxy": nowhere,
    }  # fmt: skip

    def run(name, *arguments, fork=True):
        """In a fork of a process that has imported nerfstudio, or as it is installed."""
        if fork:
            return start(name, *arguments, environment=env).end(200).printed
        path = Path(sys.executable).with_name(name)
        done = subprocess.run(
            [str(path), *map(str, arguments)], env=env, cwd=folder, capture_output=True, text=True, timeout=200
        )
        assert done.returncode == 0, f"{name} failed:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
        return done.stdout

    return run


@pytest.fixture(scope="module")
def train(command, scene, plan_file, tmp_path_factory):
    output = tmp_path_factory.mktemp("output")

    def run(timestamp, *arguments, fork=True):
        command(
            "ns-train", "mmpi-small", "--data", scene, "--output-dir", output, "--experiment-name", "tiny",
            "--timestamp", timestamp, "--vis", "tensorboard", "--machine.device-type", "cpu",
            "--max-num-iterations", STEPS, "--steps-per-save", SAVED, "--save-only-latest-checkpoint", "False",
            "--pipeline.model.plan-file", plan_file, "--pipeline.model.colour.hidden-width", "8",
            "--pipeline.model.schedule.training", "two-phase", "--pipeline.model.schedule.rays-per-mpi", "split",
            "--pipeline.model.schedule.blend-share", "0.25", "--pipeline.model.schedule.finetune-share", "0.25",
            "--pipeline.datamanager.train-num-rays-per-batch", "256", *arguments, fork=fork,
        )  # fmt: skip
        return output / "tiny" / "mmpi-small" / timestamp

    return run


@pytest.fixture(scope="module")
def run_folder(train):
    """Folder of a whole training run."""
    return train("whole", fork=False)


@pytest.fixture(scope="module")
def poses(scene):
    """Poses [6, 4, 4] of the training cameras in the frame that the model is trained in."""
    poses = datamanager(scene).train_dataset.cameras.camera_to_worlds
    return torch.cat([poses, torch.tensor([[[0.0, 0, 0, 1]]]).expand(len(poses), 1, 4)], 1)


def picture(path):
    return np.asarray(Image.open(path), np.float64)[..., :3] / 255


def resembles(rendered, i):
    """Nearer to the true image than its mean colour is."""
    truth = image_of(i)
    assert rendered.shape == truth.shape and rendered.std() > 0.05
    return ((rendered - truth) ** 2).mean() < 0.7 * ((truth - truth.mean((0, 1))) ** 2).mean()


def camera_path(poses):
    frames = [{"camera_to_world": p.flatten().tolist(), "fov": FOV, "aspect": WIDTH / HEIGHT} for p in poses]
    return {
        "render_height": HEIGHT, "render_width": WIDTH, "camera_type": "perspective", "fps": 2,
        "seconds": len(frames) / 2, "camera_path": frames,
    }  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
def test_every_method_shows_its_help(command, method):
    printed = command("ns-train", method, "--help")
    for option in ("--pipeline.model.plan-file", "--pipeline.datamanager.keypoint-rays", "--max-num-iterations"):
        assert option in printed


def test_there_are_five_methods():
    assert METHODS == ["mmpi", "mmpi-kitti", "mmpi-scannet", "mmpi-scannet-short", "mmpi-small"]


def test_training_leaves_a_config_a_plan_and_checkpoints(run_folder, plan_file):
    assert sorted(p.name for p in (run_folder / "nerfstudio_models").iterdir()) == [
        f"step-{s:09d}.ckpt" for s in (SAVED, 2 * SAVED, STEPS - 1)
    ]
    assert (run_folder / "config.yml").is_file() and list(run_folder.glob("events*"))
    assert json.loads((run_folder / "plan.json").read_text()) == json.loads(plan_file.read_text())


def test_eval_writes_metrics_and_pictures(command, run_folder, tmp_path):
    command(
        "ns-eval", "--load-config", run_folder / "config.yml", "--output-path", tmp_path / "out.json",
        "--render-output-path", tmp_path / "pictures",
    )  # fmt: skip
    actual = json.loads((tmp_path / "out.json").read_text())
    assert actual["method_name"] == "mmpi-small" and actual["checkpoint"].endswith(f"step-{STEPS - 1:09d}.ckpt")
    results = actual["results"]
    assert {"psnr", "ssim", "dropped_mass", "psnr_std"} <= set(results)
    assert results["psnr"] > 12 and 0 < results["ssim"] <= 1 and 0 <= results["dropped_mass"] < 0.2
    names = {p.name.split("-", 1)[-1] for p in (tmp_path / "pictures").iterdir()}
    assert any("img" in n for n in names) and any("winning_mpi" in n for n in names)


def test_render_follows_a_camera_path(command, run_folder, poses, tmp_path):
    (tmp_path / "path.json").write_text(json.dumps(camera_path(poses[:2])))
    command(
        "ns-render", "camera-path", "--load-config", run_folder / "config.yml", "--camera-path-filename",
        tmp_path / "path.json", "--output-path", tmp_path / "out", "--output-format", "images", "--image-format",
        "png", "--rendered-output-names", "rgb", "depth", "winning_mpi",
    )  # fmt: skip
    files = sorted((tmp_path / "out").glob("*.png"))
    assert len(files) == 2
    for i, file in enumerate(files):
        actual = picture(file)
        assert actual.shape == (HEIGHT, 3 * WIDTH, 3)
        assert resembles(actual[:, :WIDTH], TRAIN[i])
        assert actual[:, WIDTH : 2 * WIDTH].std() > 0.01


def test_render_writes_every_output_of_the_test_images(command, run_folder, tmp_path):
    command(
        "ns-render", "dataset", "--load-config", run_folder / "config.yml", "--output-path", tmp_path / "out",
        "--split", "test", "--image-format", "png",
    )  # fmt: skip
    outputs = {p.name for p in (tmp_path / "out" / "test").iterdir()}
    assert {"rgb", "gt-rgb", "depth", "accumulation", "winning_mpi"} <= outputs
    actual = sorted((tmp_path / "out" / "test" / "rgb").iterdir())
    assert len(actual) == len(TEST)
    assert all(resembles(picture(f), i) for f, i in zip(actual, TEST, strict=True))
    truth = picture(sorted((tmp_path / "out" / "test" / "gt-rgb").iterdir())[0])
    assert np.abs(truth - image_of(TEST[0])).max() < 0.01


def test_commands_of_ours_are_interrupted_without_a_traceback(tmp_path):
    running = start("mmpi-scene", "street", tmp_path / "street")
    running.wait_for("looking for points")
    running.send(signal.SIGINT)
    ended = running.end()
    assert ended.status == 130 and ended.error.strip() == "mmpi-scene: Interrupted."
