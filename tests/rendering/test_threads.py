"""Rendering a run of two windows from several threads, interrupted, and while checkpoints are saved.

nerfstudio renders each viewer tab in a thread of its own, stops it by a trace function that raises before any line,
and saves checkpoints without waiting for either.
"""

from __future__ import annotations

from threading import Thread

import pytest
import torch
from training_runs import differences, ready, trainer_config, write_windows

from mmpi_ns.field.tables import in_half_precision

STEPS = 6


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory):
    """A trainer after both windows, and cameras that ask one window, the other and both."""
    folder = tmp_path_factory.mktemp("threads")
    config = trainer_config(scene, write_windows(scene, folder / "plan.json"), folder, STEPS, training="joint")
    trainer = ready(config)
    trainer.train()
    trainer.pipeline.eval()
    return trainer


@pytest.fixture
def model(run):
    model = run.pipeline.model
    model.store.budget = 0  # every window that is not the last one asked for is let go at once
    model.store.forget(0)
    return model


def cameras_of(run):
    """One by each window's middle, and one between."""
    centers = [torch.tensor(w.center) for w in run.pipeline.model.progress.windows.windows]
    camera = run.pipeline.datamanager.train_dataset.cameras[0:1]
    actual = []
    for center in (centers[0], 0.5 * (centers[0] + centers[1]), centers[1]):
        moved = camera.to("cpu")
        moved.camera_to_worlds = camera.camera_to_worlds.clone()
        moved.camera_to_worlds[0, :, 3] = center.float()
        actual.append(moved)
    return actual


def copied(state):
    return {name: value.clone() for name, value in state.items()}


def test_three_threads_render_while_checkpoints_are_saved(run, model, tmp_path):
    """Every picture is the one that a single thread makes, and every state that is saved is the trained one."""
    cameras = cameras_of(run)
    alone = [model.get_outputs_for_camera(camera) for camera in cameras]
    trained, wrong = copied(model.state_dict()), []
    as_saved = in_half_precision(trained)

    def render(first: int) -> None:
        try:
            for i in range(first, first + 9):
                outputs = model.get_outputs_for_camera(cameras[i % 3])
                wrong.extend(name for name, v in outputs.items() if not torch.equal(v, alone[i % 3][name]))
                model.store.forget(0)  # the next one reads it again, while others still work on it
        except Exception as error:
            wrong.append(repr(error))

    threads = [Thread(target=render, args=(first,)) for first in range(3)]
    for thread in threads:
        thread.start()
    saved = 0
    while any(thread.is_alive() for thread in threads) or not saved:
        run.save_checkpoint(2 * STEPS - 1)
        path = run.checkpoint_dir / f"step-{2 * STEPS - 1:09d}.ckpt"
        state = torch.load(path, weights_only=True)["pipeline"]
        assert differences({k.removeprefix("_model."): v for k, v in state.items()}, as_saved) == []
        saved += 1
    for thread in threads:
        thread.join()
    assert wrong == [] and saved > 1
    assert differences(dict(model.state_dict()), trained) == []
