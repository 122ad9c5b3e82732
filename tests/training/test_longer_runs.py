"""Longer trainings of ``mmpi`` never give worse test images, here of a small procedural street."""

from __future__ import annotations

import copy

from training_runs import ready

from mmpi_ns.config import mmpi
from mmpi_scene import make_scene, write_dataset


def test_more_rays_for_each_pixel_do_not_lower_psnr_or_ssim(tmp_path):
    """The longer run draws each training pixel seven times."""
    write_dataset(make_scene("street", 0, 10, 48, 32, 8.0), tmp_path / "street", 400)
    scores = []
    for steps in (100, 800):
        config = copy.deepcopy(mmpi.config)
        config.output_dir, config.experiment_name, config.timestamp = tmp_path, str(steps), "run"
        config.max_num_iterations, config.steps_per_save, config.vis = steps, steps, "tensorboard"
        config.machine.device_type, config.pipeline.model.lpips_net = "cpu", "none"
        config.data = config.pipeline.datamanager.data = tmp_path / "street"
        config.pipeline.datamanager.train_num_rays_per_batch = 128
        trainer = ready(config)
        trainer.train()
        trainer.pipeline.eval()
        scores.append(trainer.pipeline.get_average_eval_image_metrics())
    short, longer = scores
    assert short["psnr"] > 27
    assert longer["psnr"] > short["psnr"] - 0.05 and longer["ssim"] > short["ssim"] - 0.002, scores
