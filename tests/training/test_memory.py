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
from mmpi_ns.training import memory, report
from mmpi_ns.training.memory import Work, describe, fit_memory, step_bytes, training_bytes
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
def test_memory_is_that_of_tables_moments_and_pixels(scene, plan_file, tmp_path, training, capsys):
    """Joint training reaches what was told to the byte; before reliability is learned bricks no ray read are given
    up, so two phases stay below it."""
    trainer = ready(trainer_config(scene, plan_file, tmp_path, 16, training=training))
    said = " ".join(capsys.readouterr().out.split())
    run, manager = trainer._run, trainer._manager
    work = Work(run.field.feature_channels, two_phase=training == "two-phase")
    (window,), pixels = run.progress.windows.windows, [manager.pixel_bytes(None)]
    tables = [training_bytes(window.plan, views_of(window, run.views), work, trainer.device)]
    trainer.train()
    most = max(bytes_of(load(trainer.checkpoint_dir, step)) for step in range(1, 16))
    assert most == tables[0] if training == "joint" else 0.5 * tables[0] < most <= tables[0]
    pool = trainer.pipeline.datamanager.sources.pixels
    assert pixels == [pool.nbytes] and pool.places is None  # which pixel it is follows from where it lies
    told = re.search(r"Memory in training: at most ([\d.]+) GiB", said)
    assert told and float(told[1]) == pytest.approx((tables[0] + pixels[0]) / 2**30, abs=0.006)


@pytest.mark.parametrize("masks", [False, True])
def test_of_a_window_with_too_many_pixels_so_many_are_held_as_is_told(scene, tmp_path, masks, capsys):
    data = write_scene(tmp_path / "masked", masks=True) if masks else scene
    manager = datamanager(data, resident_pixels=1000)
    told = manager.pixel_bytes()
    for step in range(3):
        _, batch = manager.next_train(step)
    pool = manager.sources.pixels
    assert pool.nbytes == told if not masks else 0.4 * told < pool.nbytes < told
    assert "random" in capsys.readouterr().out and len(pool.colors) <= 1000
    assert set(pool.images.tolist()) == set(range(len(TRAIN))) and (pool.ends - pool.begins > 60).all()
    for color, (camera, row, column) in zip(batch["image"], batch["indices"].tolist(), strict=True):
        assert np.abs(color.numpy() - image_of(TRAIN[camera])[row, column]).max() < 0.5 / 255 + 1e-6
        assert not masks or column < WIDTH / 2
    again, other = (datamanager(data, resident_pixels=1000, seed=seed) for seed in (0, 1))
    again.next_train(0), other.next_train(0)
    assert torch.equal(again.sources.pixels.places, pool.places) and not torch.equal(
        other.sources.pixels.places, pool.places
    )


def test_the_largest_window_decides_what_memory_is_told():
    plan = ScenePlan((make_mpi(),), None, 0.05, 1.5)
    windows = WindowedPlan(tuple(Window((x, 0.0, 0.0), 1.0, 0.1, plan) for x in (0.0, 2.0)))
    said = describe(windows, 40, [3 * 2**30, 7 * 2**29])
    assert "2 windows of 40 steps" in said and "at most 3.50 GiB of tables, moments and pixels" in said


GPU = "cuda:1"
WORK = Work(8, False, pixel_rays=16384)


def large_plan(texels: float) -> ScenePlan:
    side = round((texels / 512) ** 0.5)
    return ScenePlan(tuple(make_mpi(str(k), planes=128, height=side, width=side) for k in range(4)), None, 0.05, 1.5)


@pytest.fixture
def free(monkeypatch):
    """Sets the free memory that a GPU, which is not there, reports."""

    def set_free(gib):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(gib * 2**30), 80 * 2**30))

    return set_free


def windows_of(plan: ScenePlan) -> WindowedPlan:
    return WindowedPlan.single(plan)


@pytest.mark.parametrize(("gib", "places"), [(64, 0), (12, 1), (6, 1)])
def test_texels_of_an_automatic_plan_follow_the_free_memory(free, capsys, gib, places):
    free(gib)
    asked = []

    def again(most):
        asked.append(most)
        return windows_of(large_plan(most))

    windows = fit_memory(windows_of(large_plan(200e6)), lambda _: None, WORK, GPU, again)
    assert len(asked) == places and capsys.readouterr().out.count("texels are made larger") == places
    held = training_bytes(windows.plans[0], None, WORK) + step_bytes(windows.plans[0], WORK, GPU)
    assert held <= gib * 2**30 and (not places or held > 0.85 * gib * 2**30)


@pytest.mark.parametrize("stubborn", [True, False])
def test_where_hardly_any_texel_fits_a_run_is_refused(free, stubborn):
    free(6 if stubborn else 0.5)
    plan, asked = windows_of(large_plan(200e6)), []
    with pytest.raises(InputError, match="GiB are free"):
        fit_memory(plan, lambda _: None, WORK, GPU, lambda most: asked.append(most) or plan)
    assert len(asked) == (memory.ATTEMPTS - 1 if stubborn else 0)


def test_the_next_commands_can_be_copied_from_any_folder():
    _, *commands = report.next_commands(Path("/my photos/r")).splitlines()
    assert [shlex.split(line)[shlex.split(line).index("--load-config") + 1] for line in commands] == [
        "/my photos/r/config.yml"
    ] * 3
