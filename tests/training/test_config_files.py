"""config.yml files, of this version and of those before the model's options were in groups."""

from __future__ import annotations

import shutil
from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from nerfstudio.utils.eval_utils import eval_setup
from training_runs import datamanager, ready, trainer_config

from mmpi_ns.config import mmpi_kitti, mmpi_small
from mmpi_ns.model import MMPIModelConfig
from mmpi_ns.training.options import LEFT, TRAINED, check_nothing_left
from mmpi_ns.utils.errors import InputError

BEFORE_GROUPS = Path(__file__).with_name("config_before_groups.yml").read_text()
"""Written by ns-train mmpi-small of commit 94eda72."""


def model_of(text):
    return yaml.load(text, Loader=yaml.Loader).pipeline.model


def test_a_file_from_before_the_groups_has_every_option_in_its_group():
    changed = {"hidden_width: 64": "hidden_width: 12", "background: gray": "background: white",
               "render_threshold: 0.003": "render_threshold: 0.004", "train_threshold: 0.003": "train_threshold: 0.005",
               "render: auto": "render: exact", "training: joint": "training: two-phase",
               "decay_from: 0.5": "decay_from: 0.25"}  # fmt: skip
    text = BEFORE_GROUPS
    for before, after in changed.items():
        assert text.count(f"    {before}\n") == 1
        text = text.replace(f"    {before}\n", f"    {after}\n")
    model, usual = model_of(text), MMPIModelConfig()
    assert (model.colour.hidden_width, model.rendering.background, model.rendering.mode) == (12, "white", "exact")
    assert (model.rendering.threshold, model.sampling.threshold) == (0.004, 0.005)
    assert (model.schedule.training, model.schedule.decay_from) == ("two-phase", 0.25)
    assert (model.placement.rays_per_texel, model.loss.depth_outliers) == (2.5, 0.02), "as the file says"
    assert model.schedule.growth_shares == usual.schedule.growth_shares
    check_nothing_left(model)
    unknown = set(vars(model)) - {f.name for f in fields(model)} - set(LEFT) - TRAINED
    assert not unknown, "every option has found its group"


def test_an_option_that_left_and_changes_the_images_is_named():
    model = model_of(BEFORE_GROUPS.replace("    seed: 0\n    shading", "    seed: 0\n    ghosts: 3\n    shading"))
    with pytest.raises(InputError, match=r"asks for --pipeline.model.ghosts 3, which this version lacks"):
        check_nothing_left(model)
    model = model_of(BEFORE_GROUPS)
    model.rendering.old_way = "x"
    with pytest.raises(InputError, match=r"--pipeline.model.rendering.old-way 'x'"):
        check_nothing_left(model)


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


def test_a_capture_that_is_not_there_says_from_where_its_path_is_seen(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=rf"no data/transforms.json in {tmp_path}, from where the path is seen"):
        datamanager(Path("data"))
