"""A run through two windows, for the tests of one process and of several."""

from __future__ import annotations

import pytest
from training_runs import WINDOW_STEPS, ready, trainer_config, write_windows


@pytest.fixture(scope="module")
def windows_file(scene, tmp_path_factory):
    return write_windows(scene, tmp_path_factory.mktemp("windows") / "plan.json")


@pytest.fixture(scope="module")
def whole(scene, windows_file, tmp_path_factory):
    """An uninterrupted run through both windows."""
    config = trainer_config(scene, windows_file, tmp_path_factory.mktemp("whole"), WINDOW_STEPS, training="joint")
    config.save_config()
    trainer = ready(config)
    trainer.train()
    return trainer
