"""The device of a run, and what is said where a GPU lies idle. There is none here: torch and the system are faked."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.engine.trainer import Trainer
from training_runs import trainer_config

from mmpi_ns.config import mmpi_small
from mmpi_ns.utils import machine


class Stop(Exception):
    """Ends a preparation where nerfstudio's begins."""


@pytest.mark.parametrize(
    ("device", "steps", "rays", "keypoints"), [("cuda", 0, 4096, 1536), ("cuda", 500, 1024, 384), ("cpu", 0, 1024, 384)]
)
def test_a_large_gpu_draws_more_rays_a_step_unless_steps_were_asked_for(
    monkeypatch, tmp_path, device, steps, rays, keypoints
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "set_device", lambda _: None)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: SimpleNamespace(multi_processor_count=132))
    monkeypatch.setattr(Trainer, "setup", lambda *_: (_ for _ in ()).throw(Stop))
    config = copy.deepcopy(mmpi_small.config)
    config.machine.device_type, config.max_num_iterations = device, steps
    config.output_dir, config.experiment_name, config.timestamp = tmp_path, "tiny", "run"
    for _ in range(2):  # a config may be set up again
        with pytest.raises(Stop):
            config.setup(local_rank=0, world_size=1).setup()
        manager = config.pipeline.datamanager
        assert (manager.train_num_rays_per_batch, manager.keypoint_rays) == (rays, keypoints)
        assert config.pipeline.model.rays_times == rays // 1024


def test_a_cpu_run_asks_for_no_gpu(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "set_device", lambda _: pytest.fail("no GPU"))
    monkeypatch.setattr(Trainer, "setup", lambda *_: (_ for _ in ()).throw(Stop))
    with pytest.raises(Stop):
        trainer_config(tmp_path, None, tmp_path).setup(local_rank=0, world_size=1).setup()


@pytest.fixture
def system(monkeypatch, tmp_path):
    """A system with a GPU that torch does not see, with this driver and build of torch."""

    def make(driver, cuda, gpus=1):
        for i in range(gpus):
            (tmp_path / "gpus" / str(i)).mkdir(parents=True)
            (tmp_path / "gpus" / str(i) / "information").write_text("Model: \t\t NVIDIA GeForce RTX 3090\nIRQ: 1\n")
        (tmp_path / "version").write_text(
            f"NVRM version: NVIDIA UNIX x86_64 Kernel Module  {driver}  Sat Aug 19 01:15:15 UTC 2023\n"
            "GCC version:  gcc version 12.3.0\n"
        )
        monkeypatch.setattr(machine, "NVIDIA", tmp_path)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        monkeypatch.setattr(torch.version, "cuda", cuda)
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)

    return make
