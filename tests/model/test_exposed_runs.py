"""Runs on images of several exposures: what is kept, shown and scored."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from tiny_scene import expose, write_scene
from training_runs import ready, trainer_config, write_plan

from mmpi_ns.training.report import quick_test

FACTORS = np.random.default_rng(3).uniform(0.55, 1.0, (8, 3))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A pipeline loaded from a short run on the tiny scene, each image of which has an exposure of its own."""
    folder = tmp_path_factory.mktemp("exposed")
    data = expose(write_scene(folder / "data"), FACTORS)
    plan = write_plan(data, folder / "plan.json")
    config = trainer_config(data, plan, folder / "runs", 60, training="joint", lpips_net="none")
    config.pipeline.datamanager.new_view_share = 0.75
    config.save_config()
    trainer = ready(config)
    trainer.train()
    _, pipeline, *_ = eval_setup(config.get_base_dir() / "config.yml", test_mode="test")
    return trainer.pipeline.model.exposures, pipeline


def test_exposures_of_a_run_are_loaded_with_it(run):
    trained, pipeline = run
    assert len(trained.factors) == 6
    for name, values in trained.state_dict().items():
        assert torch.equal(pipeline.model.exposures.state_dict()[name], values)


def test_a_test_image_is_scored_at_its_own_exposure(run, monkeypatch, capsys):
    _, pipeline = run
    raw = pipeline.get_average_eval_image_metrics()
    monkeypatch.setattr(pipeline.datamanager.maker, "exposure_of", lambda *_: None)
    at_mean = pipeline.get_average_eval_image_metrics()
    assert raw["psnr"] > at_mean["psnr"] + 1
    assert raw["cc_psnr"] == pytest.approx(at_mean["cc_psnr"], abs=0.5)
    assert "scored at mean exposure" in capsys.readouterr().out


def test_pictures_are_shown_at_the_mean_exposure(run):
    _, pipeline = run
    model, cameras = pipeline.model, pipeline.datamanager.train_dataset.cameras
    image = model.get_outputs_for_camera(cameras[2:3])
    torch.testing.assert_close(image["rgb"], (model.exposures.mean * image["radiance"]).clamp(0, 1))


def test_the_quick_test_scores_as_ns_eval_does(run):
    _, pipeline = run
    said = quick_test(pipeline, pipeline.datamanager.eval_dataset)
    assert f"PSNR {pipeline.get_average_eval_image_metrics()['psnr']:.2f} dB" in said
