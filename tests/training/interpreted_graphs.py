"""Recorded steps beside steps one operation at a time, on the GPU's path: run like ops/interpreted_march.py."""

from __future__ import annotations

import pytest
import torch
from interpreting import interpreted  # noqa: F401
from nerfstudio.engine.callbacks import TrainingCallbackLocation as At
from tape import TapeRecorder
from training_runs import ready, trainer_config

from mmpi_ns.data.rays import CameraRays
from mmpi_ns.training.step_graph import MEASURED, StepGraphs

STEPS = 20


def trained(scene, plan_file, folder, training, shading, records, **settings):
    config = trainer_config(
        scene, plan_file, folder, steps=STEPS, training=training, growth_shares=(), shading=shading, **settings
    )
    config.pipeline.datamanager.train_num_rays_per_batch, config.pipeline.datamanager.keypoint_rays = 16, 8
    trainer = ready(config)
    trainer.pipeline.train()
    manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    del manager.train_ray_generator
    manager.train_ray_generator = CameraRays.of(manager.train_dataset.cameras, "cpu")
    optimizers = trainer.optimizers.optimizers

    def state():
        yield from (p.data for p in model.field.parameters())
        yield from (model.field.peak, model.field.gain, model.field.crossings, model.field.touched)
        for optimizer in optimizers.values():
            for each in optimizer.state.values():
                yield each["moments"]

    graphs = StepGraphs(model, manager, optimizers, lambda: TapeRecorder(state))
    if not records:
        graphs._measured = -(10**9)
        graphs._forget = lambda: None
    said = []
    for step in range(STEPS):
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=At.BEFORE_TRAIN_ITERATION)
        total, losses, metrics = graphs.step(step)
        trainer.optimizers.scheduler_step_all(step)
        said.append([total, *losses.values(), *metrics.values()])
        print(step, graphs.capacity, graphs.repeated, graphs.lost, float(total), flush=True)
    return graphs, said, [p.data.clone() for p in model.field.parameters()]


@pytest.mark.parametrize(("training", "shading"), [("joint", "ray"), ("two-phase", "ray"), ("two-phase", "sample")])
def test_recorded_steps_train_what_steps_one_operation_at_a_time_do(scene, plan_file, tmp_path, training, shading):
    graphs, said, params = trained(scene, plan_file, tmp_path / "a", training, shading, True)
    assert not graphs.is_off and not graphs.lost
    assert graphs.repeated >= STEPS - 5 * MEASURED
    _, expected, others = trained(scene, plan_file, tmp_path / "b", training, shading, False)
    for step, (a, b) in enumerate(zip(said, expected, strict=True)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            torch.testing.assert_close(x, y, rtol=2e-4, atol=1e-6, msg=f"step {step}: {x} {y}")
    for a, b in zip(params, others, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)
