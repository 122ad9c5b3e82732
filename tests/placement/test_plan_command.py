"""``mmpi-plan`` on the tiny scene: what it prints and writes is what training would do."""

from __future__ import annotations

import copy
import json
import sys

import numpy as np
import pytest
from PIL import Image

from mmpi_ns.config import mmpi_small
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.scripts.plan import entrypoint
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset


def run(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["mmpi-plan", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        entrypoint()
    return ended.value.code


def test_it_writes_a_plan_a_table_and_a_picture(scene, tmp_path, monkeypatch, capsys):
    run(monkeypatch, scene, "--output", tmp_path / "plan", "--placement.max-mpis", 2)
    plan = WindowedPlan.load(tmp_path / "plan" / "plan.json").plans[0]
    printed = capsys.readouterr().out
    assert all(f"| {m.name} |" in printed for m in plan.mpis) and 1 <= len(plan.mpis) <= 2
    assert printed.split("\n\nWrote")[0].strip().endswith((tmp_path / "plan" / "plan.md").read_text().strip()[-200:])
    picture = np.asarray(Image.open(tmp_path / "plan" / "plan.png").convert("RGB"))
    assert min(picture.shape[:2]) > 200 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


def test_the_plan_is_that_of_training(scene, tmp_path, monkeypatch):
    run(monkeypatch, scene, "--output", tmp_path / "plan", "--placement.max-texels", 1e5)
    config = copy.deepcopy(mmpi_small.config.pipeline)
    config.datamanager.data = scene
    config.model.total_steps, config.model.lpips_net = 0, "none"  # as the trainer
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


def test_a_missing_scene_is_one_sentence(tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, tmp_path / "nowhere", "--output", tmp_path / "plan") == 1
    assert "There is no scene at" in capsys.readouterr().err
    assert not (tmp_path / "plan").exists()


def test_a_long_capture_is_planned_window_by_window_and_its_plan_goes_back_in(tmp_path, monkeypatch, capsys):
    write_dataset(make_scene("long-road", length=180.0), tmp_path / "road", 3000, images=False)
    words = (tmp_path / "road", "--downscale-factor", 1, "--placement.max-texels", 1e6)
    run(monkeypatch, *words, "--output", tmp_path / "plan")
    printed, plan = capsys.readouterr().out, WindowedPlan.load(tmp_path / "plan" / "plan.json")
    assert len(plan) >= 2 and f"{len(plan)} windows, " in printed
    for i, window in enumerate(plan.windows):
        assert f"## Window {i}: " in printed and all(f"| {m.name} |" in printed for m in window.plan.mpis)
    drawn = np.asarray(Image.open(tmp_path / "plan" / "plan.png").convert("RGB"))
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 20
    run(monkeypatch, *words, "--output", tmp_path / "again", "--plan-file", tmp_path / "plan" / "plan.json")
    assert WindowedPlan.load(tmp_path / "again" / "plan.json") == plan
