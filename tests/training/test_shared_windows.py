"""Windows shared out among processes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from training_runs import WINDOW_STEPS as STEPS
from training_runs import differences, load, rendered, trainer_config

from mmpi_ns.field.tables import in_half_precision
from mmpi_ns.rendering.details import DETAILS_FOLDER, details_of


def torchrun(scene, windows_file, output, processes, *options):
    """The command a user would type; returns its exit status and what it said."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(processes), "--standalone"]
    command += ["-m", "mmpi_ns.scripts.train", "mmpi-small", "--data", str(scene), "--output-dir", str(output)]
    command += ["--experiment-name", "tiny", "--timestamp", "run", "--max-num-iterations", str(STEPS)]
    command += ["--machine.device-type", "cpu", "--vis", "tensorboard", "--pipeline.model.plan-file", str(windows_file)]
    command += ["--pipeline.datamanager.train-num-rays-per-batch", "64", "--pipeline.datamanager.keypoint-rays", "16"]
    command += ["--pipeline.datamanager.new-view-share", "0"]
    command += ["--pipeline.model.colour.hidden-width", "8", "--pipeline.model.colour.feature-channels", "4"]
    command += [
        "--pipeline.model.schedule.growth-shares",
        "0.5",
        "1.0",
        "--pipeline.model.schedule.release-weight",
        "0.0",
    ]
    command += ["--steps-per-save", "2", *options]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module")
def shared(scene, windows_file, tmp_path_factory):
    output = tmp_path_factory.mktemp("shared")
    status, said = torchrun(scene, windows_file, output, 2)
    assert status == 0, said[-2000:]
    return output / "tiny" / "mmpi-small" / "run", said


def test_two_processes_end_as_one_does(whole, shared):
    """Same windows, bit for bit: draws depend on seed and step alone."""
    folder, said = shared
    for name in ("window-00000.pt", "window-00001.pt"):
        ours, theirs = (torch.load(f / "windows" / name, weights_only=True) for f in (folder, whole.base_dir))
        assert differences(ours, theirs) == [], name
    wanted = load(whole.checkpoint_dir, 2 * STEPS - 1)["pipeline"]
    assert differences(load(folder / "nerfstudio_models", 2 * STEPS - 1)["pipeline"], wanted) == []
    assert [p.name for p in (folder / "nerfstudio_models").iterdir()] == [f"step-{2 * STEPS - 1:09d}.ckpt"]
    assert "All windows are trained" in said


def test_what_two_processes_trained_is_evaluated_as_any_run(whole, shared):
    _, pipeline, _, _ = eval_setup(shared[0] / "config.yml", test_mode="inference")
    assert pipeline.model.details is not None
    assert details_of(shared[0] / DETAILS_FOLDER, 2 * STEPS - 1) is not None
    pipeline.model.details = None  # the field is compared
    origins = torch.stack([torch.tensor(w.center).float() for w in whole.pipeline.model.progress.windows.windows])
    field = whole.pipeline.model.field
    trained = {name: x.clone() for name, x in field.state_dict().items()}
    field.load_state_dict(in_half_precision(trained))  # as the last checkpoint has it
    colors, expected = (rendered(p.model, origins)["rgb"] for p in (pipeline, whole.pipeline))
    field.load_state_dict(trained)
    assert torch.equal(colors, expected)


def test_another_number_of_processes_goes_on_from_the_windows_that_are_finished(
    whole, shared, scene, windows_file, tmp_path
):
    """Window 1 was cut off in the middle; its checkpoint and the file of window 0 are all that is left."""
    left = tmp_path / "left"
    (left / "windows").mkdir(parents=True)
    (left / "nerfstudio_models").mkdir()
    shutil.copy(shared[0] / "windows" / "window-00000.pt", left / "windows")
    name = f"step-{STEPS + 2:09d}.ckpt"
    shutil.copy(whole.checkpoint_dir / name, left / "nerfstudio_models")
    load_dir = ("--load-dir", str(left / "nerfstudio_models"))
    status, said = torchrun(scene, windows_file, tmp_path / "out", 1, *load_dir)
    assert status == 0, said[-2000:]
    folder = tmp_path / "out" / "tiny" / "mmpi-small" / "run"
    ours, theirs = (torch.load(f / "windows" / "window-00001.pt", weights_only=True) for f in (folder, shared[0]))
    assert differences(ours, theirs) == []


def test_more_processes_than_windows_are_refused(scene, windows_file, tmp_path):
    trainer = trainer_config(scene, windows_file, tmp_path, STEPS).setup(local_rank=0, world_size=3)
    with pytest.raises(ValueError, match=r"2 window\(s\), too few to share out among 3 processes"):
        trainer.setup()


def test_reading_a_colmap_model_leaves_the_answer_to_sigterm_as_it_was(scene):
    """torchrun ends the other processes by SIGTERM; pycolmap brings a handler of its own, which hides what we say."""
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit('ours'))\n"
        "from mmpi_priors.sfm import find_sfm_model\n"
        "assert find_sfm_model(Path(sys.argv[1])) is not None\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    command = [sys.executable, "-c", code, str(scene / "colmap" / "sparse" / "0")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (1, "ours\n")


def test_a_process_that_is_killed_ends_the_run_and_leaves_what_is_finished(scene, windows_file, tmp_path, monkeypatch):
    """The second process dies in its first step; the first window is whole, or can be trained again."""
    code = tmp_path / "code"
    code.mkdir()
    (code / "sitecustomize.py").write_text(
        "import os\n"
        "if os.environ.get('RANK') == '1':\n"
        "    import mmpi_ns.training.run as m, signal\n"
        "    m.TrainingRun.prepare_step = lambda self, attributes, step: os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(code), os.environ.get("PYTHONPATH", "")]))
    status, said = torchrun(scene, windows_file, tmp_path / "out", 2)
    assert status != 0 and "SIGKILL" in said, said[-3000:]
    assert "Ended early: another process died" in said and "--load-dir" in said, said[-3000:]
    monkeypatch.undo()
    run = tmp_path / "out" / "tiny" / "mmpi-small" / "run"
    status, said = torchrun(scene, windows_file, tmp_path / "again", 2, "--load-dir", str(run / "nerfstudio_models"))
    assert status == 0, said[-2000:]
    assert (tmp_path / "again" / "tiny" / "mmpi-small" / "run" / "windows" / "window-00001.pt").is_file()
