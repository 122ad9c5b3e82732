"""Runs that are stopped, resumed and shared: nothing is lost or mixed up, and one sentence says so."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest
import torch
import yaml
from forked import run, start_train, train

LONG = {"max_num_iterations": 100_000, "steps_per_save": 100_000}


def folder_of(output, timestamp="run"):
    return output / "tiny/mmpi-small" / timestamp


@pytest.fixture(scope="module")
def trained(whole_scene, tmp_path_factory):
    """The folder of a finished run, never changed."""
    output = tmp_path_factory.mktemp("trained")
    assert train(whole_scene, output, max_num_iterations=6).status == 0
    return folder_of(output)


@pytest.fixture
def finished(trained, tmp_path):
    """A copy of a finished run that may be damaged; its config.yml names the copy."""
    copy = shutil.copytree(trained, tmp_path / "tiny/mmpi-small/run")
    config = yaml.load((copy / "config.yml").read_text(), Loader=yaml.Loader)
    config.output_dir, config.pipeline.model.windows_folder = tmp_path, copy / "windows"
    (copy / "config.yml").write_text(yaml.dump(config))
    return copy


def evaluate(folder, tmp_path):
    return run("ns-eval", "--load-config", folder / "config.yml", "--output-path", tmp_path / "eval.json")


# Stopping ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_stopped_saves_and_says_how_to_go_on(whole_scene, tmp_path, number, status):
    running = start_train(whole_scene, tmp_path, **LONG)
    running.wait_for("batch PSNR")
    running.send(number)
    ended = running.end()
    assert ended.status == status and "Traceback" not in ended.out + ended.error
    last = ended.error.strip().splitlines()[-1]
    (checkpoint,) = (folder_of(tmp_path) / "nerfstudio_models").iterdir()
    assert str(checkpoint) in last and f"--load-dir {checkpoint.parent}" in last and last.endswith(".")
    step = torch.load(checkpoint, weights_only=True)["step"]
    assert checkpoint.name == f"step-{step:09d}.ckpt" and f"step {step + 1} of" in last


def pipe(tmp_path):
    """A pipe's end to read from, and its name."""
    os.mkfifo(tmp_path / "pipe")
    return os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK), tmp_path / "pipe"


def terminal(_):
    master, slave = os.openpty()
    os.set_blocking(master, False)
    return master, os.ttyname(slave)


@pytest.mark.parametrize(("makes", "numbers"), [(pipe, [signal.SIGINT]), (terminal, [signal.SIGHUP] * 2)])
def test_a_run_is_saved_where_those_who_read_its_output_went_too(whole_scene, tmp_path, makes, numbers):
    """Ctrl-C ends ``| tee``, too; of a terminal that is closed two signals come."""
    reader, name = makes(tmp_path)
    running, said, end = start_train(whole_scene, tmp_path, printed_to=name, **LONG), b"", time.monotonic() + 60
    while b"batch PSNR" not in said and time.monotonic() < end:
        time.sleep(0.02)
        with suppress(BlockingIOError):
            said += os.read(reader, 10_000)
    running.send(numbers[0])
    os.close(reader)
    for number in numbers[1:]:
        running.send(number)
    assert running.end().status == 128 + numbers[0], said
    assert len(list((folder_of(tmp_path) / "nerfstudio_models").iterdir())) == 1


def test_details_that_a_stopped_run_lacks_are_made_when_it_goes_on(whole_scene, finished, tmp_path):
    shutil.rmtree(finished / "details")
    again = {"load_dir": finished / "nerfstudio_models", "max_num_iterations": 6}
    said = train(whole_scene, tmp_path, **again).printed
    assert "already holds 6 of 6 steps" in said and "ns-eval" in said
    assert "no details" not in evaluate(finished, tmp_path).printed


def test_a_stopped_run_goes_on_in_its_folder(whole_scene, tmp_path):
    running = start_train(whole_scene, tmp_path, **LONG)
    running.wait_for("batch PSNR")
    running.send(signal.SIGINT)
    assert running.end().status == 130
    models = folder_of(tmp_path) / "nerfstudio_models"
    (checkpoint,) = models.iterdir()
    step = torch.load(checkpoint, weights_only=True)["step"]
    again = start_train(whole_scene, tmp_path, **LONG, load_dir=models)
    again.wait_for("Done loading")
    again.wait_for("batch PSNR")
    again.send(signal.SIGINT)
    assert again.end().status == 130
    (checkpoint,) = models.iterdir()
    assert torch.load(checkpoint, weights_only=True)["step"] > step


# Folders -------------------------------------------------------------------------------------------------------------


def test_a_new_run_into_the_folder_of_an_old_one_is_refused(whole_scene, finished, tmp_path):
    before = {p: p.read_bytes() for p in finished.rglob("*") if p.is_file()}
    said = train(whole_scene, tmp_path).sentence
    assert "holds checkpoints of an earlier run" in said and "--load-dir" in said
    assert before == {p: p.read_bytes() for p in finished.rglob("*") if p.is_file()}


# Resuming ------------------------------------------------------------------------------------------------------------


def test_another_plan_is_refused(whole_scene, trained, tmp_path):
    plan = json.loads((trained / "plan.json").read_text())
    plan["mpis"][0]["planes"] += 3
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    said = train(
        whole_scene, tmp_path, load_dir=trained / "nerfstudio_models", pipeline__model__plan_file=tmp_path / "plan.json"
    ).sentence
    assert "another scene plan" in said and "plan.json" in said


DAMAGED = {
    "cut short": lambda p: p.write_bytes(p.read_bytes()[:-500]),
    "text": lambda p: p.write_text("hello"),
    "another method's": lambda p: torch.save({"step": 5, "pipeline": {}, "optimizers": {}}, p),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_checkpoint_is_named_when_resuming(whole_scene, finished, tmp_path, case):
    path = finished / "nerfstudio_models" / "step-000000005.ckpt"
    DAMAGED[case](path)
    assert str(path) in train(whole_scene, tmp_path / "new", load_dir=path.parent).sentence


class Runs:
    """Pickled, it makes a file when it is read."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


# Evaluating ----------------------------------------------------------------------------------------------------------


def test_a_checkpoint_cannot_run_code(whole_scene, finished, tmp_path):
    path = finished / "nerfstudio_models" / "step-000000005.ckpt"
    torch.save(torch.load(path, weights_only=True) | {"scalers": Runs(tmp_path / "ran")}, path)
    assert str(path) in train(whole_scene, tmp_path / "new", load_dir=path.parent).sentence
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("command", ["ns-eval", "mmpi-export"])
def test_a_capture_by_a_relative_path_of_another_folder_is_told(finished, tmp_path, command):
    config = yaml.load((finished / "config.yml").read_text(), Loader=yaml.Loader)
    config.pipeline.datamanager.data = Path("captures/tiny")  # as ns-train wrote it once
    (finished / "config.yml").write_text(yaml.dump(config))
    output = ["--output-path", tmp_path / "eval.json"] if command == "ns-eval" else ["--output", tmp_path / "out"]
    words = (command, *(["bake"] if command == "mmpi-export" else []), "--load-config", finished / "config.yml")
    said = run(*words, *output).sentence
    assert said.startswith(f"There is no captures/tiny/transforms.json in {Path.cwd()}, from where the path is seen")


def test_a_run_ends_with_a_quick_test_and_commands_that_can_be_copied(whole_scene, tmp_path):
    ended = train(whole_scene, tmp_path, max_num_iterations=12)
    lines = ended.out.splitlines()
    config = folder_of(tmp_path) / "config.yml"
    first = next(i for i, line in enumerate(lines) if line.startswith("Capture: 6 training and 2 test images of 32 x"))
    assert lines[first + 1].startswith("Scene plan") and any(x.startswith("Memory") for x in lines[first:])
    assert any(x.startswith("step 12 of 12 | joint | ") and "rays/s | batch PSNR" in x for x in lines), lines
    end = next(i for i, line in enumerate(lines) if line.startswith("Training finished: 12 steps in"))
    assert lines[end + 1].startswith("Quick test on 2 of 2 test images: PSNR ") and "SSIM" in lines[end + 1]
    assert lines[end + 2] == f"The run is in {config.parent}. Next:"
    names = [line.split()[0] for line in lines[end + 3 :]]
    assert names == ["ns-eval", "ns-render", "ns-viewer"] and all(f" {config}" in x for x in lines[end + 3 :])
