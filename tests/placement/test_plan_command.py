"""``mmpi-plan`` on the tiny scene: what it prints and writes is what training would do."""

from __future__ import annotations

import copy
import json
import sys

import numpy as np
import pytest
from PIL import Image
from procedural import observations_of

from mmpi_ns.config import mmpi, mmpi_small
from mmpi_ns.placement.defaults import DEFAULTS
from mmpi_ns.placement.observations import find_visible_points
from mmpi_ns.placement.rule import PlacementConfig, place
from mmpi_ns.placement.show import describe_facing, explain, table
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.scripts.plan import PlanCommand, entrypoint
from mmpi_ns.utils.errors import InputError
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset


def run(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["mmpi-plan", *map(str, words)])
    entrypoint()


def test_it_writes_a_plan_a_table_and_pictures(scene, tmp_path, monkeypatch, capsys):
    run(monkeypatch, scene, "--output", tmp_path / "plan", "--placement.max-mpis", 2)
    plan = WindowedPlan.load(tmp_path / "plan" / "plan.json").plans[0]
    printed = capsys.readouterr().out
    assert all(f"| {m.name} |" in printed for m in plan.mpis) and 1 <= len(plan.mpis) <= 2
    assert printed.split("\n\nWrote")[0].strip().endswith((tmp_path / "plan" / "plan.md").read_text().strip()[-200:])
    for name in ("plan.png", "errors.png"):
        picture = np.asarray(Image.open(tmp_path / "plan" / name).convert("RGB"))
        assert min(picture.shape[:2]) > 200 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


def test_the_plan_is_that_of_training(scene, tmp_path, monkeypatch):
    run(monkeypatch, scene, "--output", tmp_path / "plan", "--placement.max-texels", 1e5)
    config = copy.deepcopy(mmpi_small.config.pipeline)
    config.datamanager.data = scene
    config.model.method, config.model.total_steps, config.model.lpips_net = "mmpi-small", 0, "none"  # as the trainer
    config.model.placement.max_texels = 1e5
    pipeline = config.setup(device="cpu", test_mode="val")
    assert pipeline.datamanager.priors.depths.share > 0.1
    assert pipeline.model.progress.windows == WindowedPlan.load(tmp_path / "plan" / "plan.json")


def test_an_edited_plan_is_explained_and_kept(scene, tmp_path, monkeypatch, capsys):
    run(monkeypatch, scene, "--output", tmp_path / "a")
    data = json.loads((tmp_path / "a" / "plan.json").read_text())
    data["mpis"][0] |= {"name": "moved by hand", "planes": 17}
    (tmp_path / "edited.json").write_text(json.dumps(data))
    run(monkeypatch, scene, "--output", tmp_path / "b", "--plan-file", tmp_path / "edited.json")
    assert "| moved by hand |" in capsys.readouterr().out
    assert (
        WindowedPlan.load(tmp_path / "b" / "plan.json").plans[0] == WindowedPlan.load(tmp_path / "edited.json").plans[0]
    )


def test_the_defaults_are_those_of_the_method(tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(PlanCommand, "main", lambda command: commands.append(command))
    for name, method in (("mmpi", mmpi), ("mmpi-small", mmpi_small)):
        for words in (["scene", "--method", name], [f"--method={name}", "scene"]):
            run(monkeypatch, *words, "--output", tmp_path)
            assert commands[-1].placement == method.config.pipeline.model.placement
            rays = method.config.pipeline.datamanager.train_num_rays_per_batch
            assert DEFAULTS[name].rays == rays
    run(monkeypatch, "scene", "--output", tmp_path)
    assert commands[-1].placement == mmpi_small.config.pipeline.model.placement


def test_a_missing_scene_is_one_sentence(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="There is no scene at"):
        run(monkeypatch, tmp_path / "nowhere", "--output", tmp_path / "plan")
    assert not (tmp_path / "plan").exists()


def test_the_table_adds_up():
    observations = observations_of(make_scene("object"), per_camera=25)
    plan = place(observations, PlacementConfig(arrangement="room", cube_voxels=32))
    report = explain(plan, observations, find_visible_points(observations))
    assert plan.cube is not None and len(report.shares) == len(plan.mpis) + 1
    assert report.shares.sum() + report.unserved == pytest.approx(1)
    assert (report.error_without >= report.error_with).all() and 1 <= report.overlap <= plan.num_heads
    assert len(table(plan, observations, report).splitlines()) == plan.num_heads + 4


def test_facings_are_named_in_the_cameras_frame():
    base = np.eye(3)  # right, down, forward
    named = {(0, 0, 1): "front", (1, 0, 0): "right", (-1, 0, 0): "left", (0, 1, 0): "below", (0, 0, -1): "back"}
    for direction, name in named.items():
        assert describe_facing(np.array(direction, float), base) == name
    assert describe_facing(np.array([0.5, 0, 0.8660254]), base) == "front, 30 deg off"


def test_a_long_capture_is_planned_window_by_window_and_its_plan_goes_back_in(tmp_path, monkeypatch, capsys):
    write_dataset(make_scene("long-road", length=180.0), tmp_path / "road", 3000, images=False)
    words = (tmp_path / "road", "--downscale-factor", 1, "--placement.max-texels", 1e6)
    run(monkeypatch, *words, "--output", tmp_path / "plan")
    printed, plan = capsys.readouterr().out, WindowedPlan.load(tmp_path / "plan" / "plan.json")
    assert len(plan) >= 2 and f"{len(plan)} windows, " in printed
    for i, window in enumerate(plan.windows):
        assert f"## Window {i}: " in printed and all(f"| {m.name} |" in printed for m in window.plan.mpis)
        assert (tmp_path / "plan" / f"plan-{i}.png").is_file() and (tmp_path / "plan" / f"errors-{i}.png").is_file()
    drawn = np.asarray(Image.open(tmp_path / "plan" / "plan.png").convert("RGB"))
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 20
    run(monkeypatch, *words, "--output", tmp_path / "again", "--plan-file", tmp_path / "plan" / "plan.json")
    assert WindowedPlan.load(tmp_path / "again" / "plan.json") == plan
