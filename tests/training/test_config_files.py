"""config.yml files, of this version and of earlier ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml
from nerfstudio.utils.eval_utils import eval_setup
from training_runs import ready, trainer_config

from mmpi_ns.config import mmpi_kitti, mmpi_small


@pytest.mark.parametrize("method", [mmpi_small, mmpi_kitti])
def test_a_file_of_this_version_is_read_as_it_was_written(method):
    config = method.config
    assert yaml.load(yaml.dump(config), Loader=yaml.Loader).pipeline.model == config.pipeline.model


def test_a_run_is_read_from_another_folder_than_it_was_trained_in(scene, plan_file, tmp_path, monkeypatch):
    """--data and --output-dir were relative paths, of the folder where ns-train ran."""
    (tmp_path / "there").mkdir()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "there")
    shutil.copytree(scene, "data")
    config = trainer_config(Path("data"), plan_file, Path("runs"), 2, lpips_net="none")
    config.save_config()
    ready(config).train()
    assert config.output_dir == Path("runs") and config.data == Path("data"), "the run itself keeps what it was given"
    monkeypatch.chdir(tmp_path / "elsewhere")
    _, pipeline, checkpoint, step = eval_setup(tmp_path / "there" / config.get_base_dir() / "config.yml")
    assert step == 1 and checkpoint.parent.parent.parent.name == "mmpi-small" and len(pipeline.datamanager.eval_dataset)
