"""The benchmark of several processes; its trainings are stood in for (test_window_training.py runs real ones)."""

from __future__ import annotations

import json

import pytest
import torch
from processes import Processes, headline

from mmpi_ns.scene.windows import WindowedPlan
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    folder = tmp_path_factory.mktemp("road")
    write_dataset(make_scene("long-road", length=180.0), folder, 4000, images=False)
    return folder


@pytest.fixture
def command(road, tmp_path, monkeypatch):
    made = Processes(road, downscale_factor=1, output=tmp_path, work=tmp_path / "work")

    def train(count: int, steps: int) -> float:
        plan = WindowedPlan.load(made.folder / "plan.json")
        for window in range(len(plan)):
            path = made._folder(count, steps) / f"run/mmpi-small/1/windows/window-{window:05d}.pt"
            path.parent.mkdir(parents=True, exist_ok=True)
            density = torch.ones(3) + (0.25 if count > 1 and window == 1 else 0.0)
            torch.save({"window": window, "field": {"density": density, "empty": torch.zeros(0)}}, path)
        return 30.0 + steps * (0.2 if count == 1 else 0.1)

    monkeypatch.setattr(made, "_train", train)
    return made


def test_throughput_leaves_out_what_is_done_once(command, tmp_path):
    command.run()
    found = json.loads((tmp_path / "processes.json").read_text())
    windows = len(WindowedPlan.load(command.folder / "plan.json"))
    assert windows >= 2
    assert found["headline"]["throughput_ratio"] == pytest.approx(2.0)
    assert found["headline"]["one_steps_per_s"] == pytest.approx(windows / 0.2)
    assert found["headline"]["largest_difference"] == 0.25
    text = (tmp_path / "processes.md").read_text()
    assert "| 2 | 34.0 | 54.0 |" in text and "differ by at most 0.25" in text


def test_what_was_timed_is_not_timed_again(command, monkeypatch):
    command.run()
    monkeypatch.setattr(command, "_train", lambda *_: pytest.fail("trained again"))
    command.run()


def test_a_capture_of_few_windows_is_refused(command):
    command.processes = 50
    with pytest.raises(ValueError, match="too few for 50 processes: give a longer capture"):
        command.run()


def test_rates_are_of_the_steps_in_between():
    rows = {1: {10: 20.0, 110: 70.0}, 3: {10: 25.0, 110: 45.0}}
    found = headline(rows, 3, windows=6, few=10, steps=110)
    assert found == {"one_steps_per_s": 12.0, "several_steps_per_s": 30.0, "throughput_ratio": 2.5}
