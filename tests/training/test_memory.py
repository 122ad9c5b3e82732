"""What is said of a run: before it starts the memory that it takes (memory.py), and at its end how to go on."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from hand_made import make_mpi
from tiny_scene import TRAIN, WIDTH, image_of, write_scene
from training_runs import datamanager, load, ready, trainer_config

from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.windows import Window, WindowedPlan
from mmpi_ns.training import report
from mmpi_ns.training.memory import check_memory, describe, texel_bytes, training_bytes
from mmpi_ns.training.run import views_of
from mmpi_ns.utils.errors import InputError


def bytes_of(state) -> int:
    """Tensors of a field's tables and of their moments in a checkpoint."""
    field = {k.removeprefix("_model.field."): v for k, v in state["pipeline"].items() if "_model.field." in k}
    tables = sum(
        v.nbytes
        for k, v in field.items()
        if k not in ("networks.weights", "plan_bytes", "crossings", "copied", "texel_factor")
    )
    moments = [state["optimizers"][k]["state"].get(0, {}) for k in ("density", "features", "reliability")]
    return tables + sum(m[k].nbytes for m in moments for k in m if k != "step")


@pytest.mark.parametrize("training", ["joint", "two-phase"])
def test_memory_is_that_of_tables_and_moments(scene, plan_file, tmp_path, training, capsys):
    """Joint training reaches what was told to the byte; before reliability is learned bricks no ray read are given
    up, so two phases stay below it."""
    trainer = ready(trainer_config(scene, plan_file, tmp_path, 16, training=training))
    said = " ".join(capsys.readouterr().out.split())
    run = trainer._run
    per_texel = texel_bytes(run.field.feature_channels, two_phase=training == "two-phase")
    (window,) = run.progress.windows.windows
    tables = training_bytes(window.plan, views_of(window, run.views), per_texel, trainer.device)
    trainer.train()
    most = max(bytes_of(load(trainer.checkpoint_dir, step)) for step in range(1, 16))
    assert most == tables if training == "joint" else 0.5 * tables < most <= tables
    assert trainer.pipeline.datamanager.sources.pixels.places is None  # which pixel it is follows from where it lies
    told = re.search(r"Memory in training: at most ([\d.]+) GiB", said)
    assert told and float(told[1]) == pytest.approx(tables / 2**30, abs=0.006)


@pytest.mark.parametrize("masks", [False, True])
def test_of_a_window_with_too_many_pixels_so_many_are_held(scene, tmp_path, masks, capsys):
    data = write_scene(tmp_path / "masked", masks=True) if masks else scene
    manager = datamanager(data, resident_pixels=1000)
    for step in range(3):
        _, batch = manager.next_train(step)
    pool = manager.sources.pixels
    assert "random" in capsys.readouterr().out
    assert 990 < len(pool.colors) <= 1000 or (masks and 400 < len(pool.colors) < 600)
    assert set(pool.images.tolist()) == set(range(len(TRAIN))) and (pool.ends - pool.begins > 60).all()
    for color, (camera, row, column) in zip(batch["image"], batch["indices"].tolist(), strict=True):
        assert np.abs(color.numpy() - image_of(TRAIN[camera])[row, column]).max() < 0.5 / 255 + 1e-6
        assert not masks or column < WIDTH / 2
    again, other = (datamanager(data, resident_pixels=1000, seed=seed) for seed in (0, 1))
    again.next_train(0), other.next_train(0)
    assert torch.equal(again.sources.pixels.places, pool.places) and not torch.equal(
        other.sources.pixels.places, pool.places
    )


def test_windows_and_memory_are_told():
    plan = ScenePlan((make_mpi(),), None, 0.05, 1.5)
    windows = WindowedPlan(tuple(Window((x, 0.0, 0.0), 1.0, 0.1, plan) for x in (0.0, 2.0)))
    said = describe(windows, 40, 7 * 2**29)
    assert "2 windows of 40 steps" in said and "at most 3.50 GiB of tables and moments" in said


GPU = "cuda:1"
PER_TEXEL = texel_bytes(8, False)


def large_plan(texels: float) -> ScenePlan:
    side = round((texels / 512) ** 0.5)
    return ScenePlan(tuple(make_mpi(str(k), planes=128, height=side, width=side) for k in range(4)), None, 0.05, 1.5)


@pytest.fixture
def free(monkeypatch):
    """Sets the free memory that a GPU, which is not there, reports."""

    def set_free(gib):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(gib * 2**30), 80 * 2**30))

    return set_free


def test_a_plan_for_which_too_little_memory_is_free_is_refused_with_the_texels_that_fit(free):
    free(64)
    check_memory(WindowedPlan.single(large_plan(200e6)), lambda _: None, PER_TEXEL, GPU)
    free(12)
    with pytest.raises(InputError, match="GiB are free") as error:
        check_memory(WindowedPlan.single(large_plan(200e6)), lambda _: None, PER_TEXEL, GPU)
    most = float(re.search(r"max-texels (\S+)\.$", str(error.value))[1])
    plan = large_plan(most)
    assert 0.8 * 12 * 2**30 < training_bytes(plan, None, PER_TEXEL) <= 12 * 2**30


def test_the_next_commands_can_be_copied_from_any_folder():
    _, *commands = report.next_commands(Path("/my photos/r")).splitlines()
    assert [shlex.split(line)[shlex.split(line).index("--load-config") + 1] for line in commands] == [
        "/my photos/r/config.yml"
    ] * 3
