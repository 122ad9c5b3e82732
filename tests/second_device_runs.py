"""Trainings on a device that is not the CPU, in a process of their own (``training/test_second_device.py``)."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
import second_device
import torch
from training_runs import trainer_config

from mmpi_ns.rendering.details import details_of
from mmpi_ns.scene.plan import ScenePlan

STEPS = 24
RUNS = {
    "two-phase": {},
    "samples shaded": {"shading": "sample", "training": "joint"},
    "copies": {"training": "joint", "release_shares": (0.5, 0.7, 0.9), "release_weight": 0.06, "decay_from": 0.8},
}


@pytest.fixture(scope="module", autouse=True)
def device():
    second_device.register(Path(os.environ["BUILD"]))


def train(scene: Path, plan: Path, output: Path, device: str, load_dir: Path | None = None, **options):
    config = trainer_config(scene, plan, output, STEPS, ops="torch", lpips_net="none", **options)
    config.machine.device_type, config.pipeline.datamanager.new_view_share = device, 0.4
    config.load_dir, config.load_step = load_dir, None if load_dir is None else STEPS - 6
    trainer = config.setup(local_rank=0, world_size=1)
    torch.manual_seed(0)
    trainer.setup()
    trainer.train()
    assert details_of(trainer.base_dir / "details", STEPS - 1) is not None
    return trainer


def test_tensors_of_two_devices_are_refused():
    here, there = torch.ones(3), torch.ones(3, device="second")
    for mix in (lambda: here + there, lambda: torch.isin(there, here), lambda: there.index_add(0, here.long(), there)):
        with pytest.raises(RuntimeError, match="same device"):
            mix()
    with pytest.raises(TypeError, match="second"):
        there.numpy()
    assert (there + 1).cpu().tolist() == [2, 2, 2] and there[torch.tensor([0, 2])].device.type == "second"


@pytest.mark.parametrize("name", RUNS)
def test_a_run_ends_there_as_on_the_cpu(name, scene, plan_file, tmp_path):
    plan = tmp_path / "plan.json"
    detail = 64.0 if name == "copies" else 1.0
    plan.write_text(replace(ScenePlan.from_json(plan_file.read_text()), detail=detail).to_json())
    scores = {}
    for device in ("cpu", "second"):
        trainer = train(scene, plan, tmp_path / device, device, **RUNS[name])
        assert {p.device.type for p in trainer.pipeline.model.parameters()} == {device}
        assert (trainer.pipeline.model.field.num_copies > 0) == (name == "copies")
        scores[device] = trainer.pipeline.get_average_eval_image_metrics()
    for metric in ("psnr", "ssim"):
        assert scores["second"][metric] == pytest.approx(scores["cpu"][metric], abs=0.02)
    train(scene, plan, tmp_path / "again", "second", load_dir=trainer.checkpoint_dir, **RUNS[name])
