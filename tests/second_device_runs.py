"""Trainings on a device that is not the CPU, on a machine without a GPU: what mixes devices fails as on a GPU.

It is torch's slot for devices of others (``second``), with the CPU's memory and operations (``second_device.cpp``).
Once a process has registered it, it stays: ``training/test_second_device.py`` starts a process for these tests.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import nn
from torch.utils import cpp_extension
from training_runs import trainer_config

from mmpi_ns.rendering.details import details_of
from mmpi_ns.scene.plan import ScenePlan

STEPS = 24
RUNS = {
    "two-phase": {},
    "samples shaded": {"shading": "sample", "training": "joint"},
    "copies": {"training": "joint", "release_shares": (0.5, 0.7, 0.9), "release_weight": 0.06, "decay_from": 0.8},
}


SOURCE = Path(__file__).with_name("second_device.cpp")


def register(build: Path) -> None:
    """Makes ``second`` a device of torch in this process, compiled in a folder (half a minute)."""
    flags = ["-O0", "-DNDEBUG", "-std=c++17"]
    cpp_extension.load("second_device", [str(SOURCE)], flags, build_directory=str(build), is_python_module=False)
    torch.utils.rename_privateuse1_backend("second")
    torch._register_device_module("second", _module())
    torch.utils.generate_methods_for_privateuse1_backend(for_storage=True)
    nn.Module._apply = _apply  # type: ignore[method-assign]


def _module() -> ModuleType:
    """``torch.second``, as ``torch.cuda``."""
    module: Any = ModuleType("torch.second")
    module.is_available = module.is_initialized = lambda: True
    module.device_count, module.current_device = lambda: 1, lambda: 0
    module._is_in_bad_fork = lambda: False
    module.manual_seed_all = module._lazy_init = lambda *_: None
    module.get_amp_supported_dtype = lambda: [torch.float16, torch.bfloat16]
    return module


_moved = nn.Module._apply


def _apply(self: nn.Module, fn: Any, recurse: bool = True) -> nn.Module:
    """torch keeps the objects of parameters that move to a GPU, but not of those that move to a device of others."""
    before = dict(self._parameters)
    _moved(self, fn, recurse)
    for name, old in before.items():
        new = self._parameters[name]
        if new is not None and type(new) is not type(old):
            new.__class__ = type(old)
            new.__dict__.update(vars(old))
    return self


@pytest.fixture(scope="module", autouse=True)
def device():
    register(Path(os.environ["BUILD"]))


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
    if name == "two-phase":
        train(scene, plan, tmp_path / "again", "second", load_dir=trainer.checkpoint_dir, **RUNS[name])
