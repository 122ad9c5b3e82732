"""The model on the tiny scene: what every phase trains, and what comes out when it renders."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import torchmetrics.image.lpip
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import OrientedBox
from random_scenes import dense_grad, of_rays
from tiny_scene import HEIGHT, WIDTH, write_scene
from training_runs import ready, trainer_config, write_plan

import mmpi_ns.model
from mmpi_ns.config import mmpi_small
from mmpi_ns.rendering.metrics import ImageMetrics
from mmpi_ns.training.phases import TRAINS

KINDS = ("density", "features", "colour", "reliability")


def trainer_of(scene, plan_file, folder, **settings):
    return ready(trainer_config(scene, plan_file, folder, **settings))


def run_step(trainer, step):
    """Losses of one step, before the optimisers act."""
    trainer.pipeline.model.run.prepare_step(None, step)
    trainer.pipeline.train()
    outputs, losses, metrics = trainer.pipeline.get_train_loss_dict(step)
    return outputs["training"], losses, metrics


@pytest.fixture(scope="module")
def trained(scene, plan_file, tmp_path_factory):
    """A trainer after a whole short run with all phases."""
    trainer = trainer_of(scene, plan_file, tmp_path_factory.mktemp("trained"), steps=60)
    trainer.train()
    return trainer


@pytest.fixture
def model(trained):
    trained.pipeline.eval()
    yield trained.pipeline.model
    trained.pipeline.model.show.value = "all"


@pytest.fixture
def camera(trained):
    return trained.pipeline.datamanager.eval_dataset.cameras[0:1]


# Training ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{"rays_per_mpi": "split"}, {"rays_per_mpi": "all"}, {"training": "joint"},
                                      {"shading": "sample"}])  # fmt: skip
def test_every_phase_has_finite_losses_and_trains_what_it_says(scene, plan_file, tmp_path, settings):
    trainer = trainer_of(scene, plan_file, tmp_path, steps=24, **settings)
    schedule = trainer.pipeline.model.progress.schedule
    names = [p.name for p in schedule.phases]
    assert names == (["joint"] if "training" in settings else ["individual", "blend", "finetune"])
    for phase in schedule.phases:
        _, losses, metrics = run_step(trainer, phase.start)
        assert {"rgb_loss", "point_color", "entropy", "distortion", "keypoint_depth"} <= set(losses)
        assert all(torch.isfinite(v) and v.ndim == 0 for v in losses.values())
        assert metrics["intersected_samples"] > 8 and 0 < metrics["kept_samples"] <= metrics["intersected_samples"]
        groups = trainer.pipeline.model.get_param_groups()
        assert {k for k in KINDS if groups[k][0].requires_grad} == TRAINS[phase.name] & set(KINDS)
        trainer.optimizers.zero_grad_all()
        sum(losses.values()).backward()
        with_gradient = {k for k in KINDS if groups[k][0].grad is not None}
        assert with_gradient == TRAINS[phase.name] & set(KINDS)
        for k in with_gradient:
            assert torch.isfinite(groups[k][0].grad).all()


def test_in_the_individual_phase_a_ray_goes_to_one_mpi_and_the_cube(scene, plan_file, tmp_path):
    trainer = trainer_of(scene, plan_file, tmp_path, sampling__threshold=0.0)

    def heads_of_rays(step):
        rays = run_step(trainer, step)[0]
        return [tuple(sorted({*h.tolist()} - {2})) for h in of_rays(rays, rays.samples.heads)]

    actual = heads_of_rays(0)
    assert len(actual) == 80 and set(actual) == {(0,), (1,)}
    assert 20 < actual.count((0,)) < 60 and actual == heads_of_rays(0) and actual != heads_of_rays(1)
    blend = trainer.pipeline.model.progress.schedule.phases[1].start
    assert set(heads_of_rays(blend)) == {(0, 1)}


def test_with_rays_per_mpi_all_every_mpi_renders_every_ray_alone_with_the_cube(scene, tmp_path):
    plan = write_plan(scene, tmp_path / "plan.json", num_mpis=3, with_cube=True)
    trainer = trainer_of(scene, plan, tmp_path, rays_per_mpi="all", sampling__threshold=0.0)
    rays, losses, _ = run_step(trainer, 0)
    heads = of_rays(rays, rays.samples.heads)
    assert len(rays.bundle) == 3 * 80
    for k in range(3):
        assert set(torch.cat(heads[80 * k : 80 * (k + 1)]).tolist()) == {k, 3}
    assert torch.equal(rays.bundle.origins[:80], rays.bundle.origins[160:])
    assert all(torch.isfinite(v) for v in losses.values())


def test_one_mpi_has_nothing_to_blend_with_and_trains_in_one_go(scene, tmp_path):
    plan = write_plan(scene, tmp_path / "plan.json", num_mpis=1)
    trainer = trainer_of(scene, plan, tmp_path, training="two-phase")
    model = trainer.pipeline.model
    assert [p.name for p in model.progress.schedule.phases] == ["joint"]
    assert model.field.layout.depth_scale == 1
    for step in (0, 12, 23):
        _, losses, _ = run_step(trainer, step)
        assert all(torch.isfinite(v) for v in losses.values())


@pytest.mark.parametrize("training", ["two-phase", "joint"])
def test_the_cube_learns_from_the_first_step_at_the_default_settings(scene, plan_file, tmp_path, training):
    config = mmpi_small.config.pipeline.model.sampling
    trainer = trainer_of(
        scene, plan_file, tmp_path, training=training,
        cube_alpha=config.cube_alpha, sampling__threshold=config.threshold,
    )  # fmt: skip
    rays, losses, _ = run_step(trainer, 0)
    intersected = rays.samples.num_intersected.sum() - (rays.samples.heads < 2).sum()
    kept = (rays.samples.heads == 2).sum()
    assert intersected > 100 and kept > 0.5 * intersected
    sum(losses.values()).backward()
    field = trainer.pipeline.model.field
    assert dense_grad(field.density)[field.grids[-1].rows].abs().sum() > 0


def test_transparent_pixels_are_trained_and_measured_over_a_background(tmp_path):
    data = write_scene(tmp_path / "alpha", alpha=True)
    plan = write_plan(data, tmp_path / "plan.json")
    trainer = trainer_of(data, plan, tmp_path, steps=4, background="white")
    trainer.train()
    trainer.pipeline.eval()
    model = trainer.pipeline.model
    camera, batch = trainer.pipeline.datamanager.next_eval_image(0)
    assert batch["image"].shape[-1] == 4
    _, images = model.get_image_metrics_and_images(model.get_outputs_for_camera(camera), batch)
    observed = images["img"][:, :WIDTH]
    assert (observed[: HEIGHT // 4] == 1).all() and observed[HEIGHT // 4 :].mean() < 0.9


def test_training_lowers_the_error(trained, model):
    camera, batch = trained.pipeline.datamanager.next_eval_image(0)
    outputs = model.get_outputs_for_camera(camera)
    error = ((outputs["rgb"] - batch["image"][..., :3]) ** 2).mean()
    assert error < 0.7 * batch["image"].var(), "no better than one colour for all"


# Rendering -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("near", "far"), [(0.5, 3.0), (3.0, 5.0), (4.0, math.inf)])
def test_nears_and_fars_that_are_preset_cut_the_scene(model, camera, near, far):
    rays = camera.generate_rays(0, keep_shape=False)
    whole = model(rays)
    rays.nears, rays.fars = torch.full_like(rays.pixel_area, near), torch.full_like(rays.pixel_area, far)
    cut = model(rays)
    kept = cut["accumulation"] > 0.05  # less may be samples too thin to be kept, which have no depth
    assert (cut["depth"][kept] >= near - 1e-3).all() and (cut["depth"][kept] <= far + 1e-3).all()
    assert (cut["accumulation"] <= whole["accumulation"] + 1e-4).all()
    assert (cut["rgb"] - whole["rgb"]).abs().max() > 0.01


def test_a_crop_shows_the_background_around_a_box(model, camera):
    outputs = model.get_outputs_for_camera(camera)
    middle = camera.camera_to_worlds[0, :, 3] - 4 * camera.camera_to_worlds[0, :, 2]
    box = OrientedBox.from_params(tuple(middle.tolist()), (0.0, 0.0, 0.0), (1.5, 3.0, 1.5))
    cropped = model.get_outputs_for_camera(camera, obb_box=box)
    rays = camera.generate_rays(0, keep_shape=True, obb_box=box)
    misses = rays.nears[..., 0] >= 1e10
    assert 0.1 < misses.float().mean() < 0.95
    assert (cropped["accumulation"][misses] == 0).all() and (cropped["rgb"][misses] == 0.5).all()
    assert cropped["accumulation"][~misses].max() > 0.05 and torch.isfinite(cropped["depth"]).all()
    assert (cropped["accumulation"] <= outputs["accumulation"] + 1e-4).all()
    fisheye = Cameras(camera.camera_to_worlds, 20.0, 20.0, 10.5, 10.5, 21, 21, camera_type=CameraType.FISHEYE)
    assert torch.isfinite(model.get_outputs_for_camera(fisheye, obb_box=box)["rgb"]).all()  # also in its centre


def test_the_viewer_can_show_one_mpi_alone(model, camera):
    everything = model.get_outputs_for_camera(camera)
    assert list(model.show.options) == ["all", "mpi0", "mpi1", "cube"]
    pictures = [everything["rgb"]]
    for i, name in enumerate(model.field.plan.names):
        model.show.value = name
        alone = model.get_outputs_for_camera(camera)
        assert (alone["winning_mpi"][alone["accumulation"] > 1e-6] == i).all()
        assert alone["accumulation"].max() > 0.01
        assert all((alone["rgb"] - p).abs().max() > 0.01 for p in pictures)
        pictures.append(alone["rgb"])
    model.show.value = "all"
    assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], everything["rgb"])


def test_the_winning_mpi_is_the_one_that_gives_most_of_the_light(model, camera):
    with torch.no_grad():
        for k in range(2):
            rows = [model.field.grids[j].rows for j in range(3)]
            before = model.field.reliability.data.clone()
            model.field.reliability.data[rows[k]] = 30.0
            for other in {0, 1, 2} - {k}:
                model.field.reliability.data[rows[other]] = -30.0
            outputs = model.get_outputs_for_camera(camera)
            model.field.reliability.data.copy_(before)
            assert (outputs["winning_mpi"] == k).float().mean() > 0.9


# A checkpoint's own plan ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("training", ["joint", "two-phase"])
def test_a_checkpoint_renders_the_same_in_a_model_that_was_placed_otherwise(
    scene, plan_file, tmp_path, camera, training
):
    """As in evaluation without the images: placement finds less there, so K differs until the checkpoint is read."""
    trained = trainer_of(scene, plan_file, tmp_path, steps=8, training=training).pipeline.model.eval()
    other = write_plan(scene, tmp_path / "other.json", num_mpis=1, planes=20)
    read = trainer_of(scene, other, tmp_path, steps=8, training=training).pipeline.model.eval()
    read.load_state_dict(trained.state_dict())
    for name in ("rgb", "accumulation", "depth"):
        expected, actual = (m.get_outputs_for_camera(camera)[name] for m in (trained, read))
        assert torch.equal(expected, actual), name
    assert read.show.options == ["all", *trained.field.full_plan.names]
    assert read.field.blends == trained.field.blends


def test_the_weight_of_depth_priors_falls_with_the_rates(scene, plan_file, tmp_path, monkeypatch):
    trainer, weights = trainer_of(scene, plan_file, tmp_path, training="joint"), []
    real = mmpi_ns.model.batch_losses

    def recorded(*args):
        weights.append(args[3].depth_priors * float(args[6]))
        return real(*args)

    monkeypatch.setattr(mmpi_ns.model, "batch_losses", recorded)
    model = trainer.pipeline.model
    half, last = model.progress.schedule.total_steps // 2, model.progress.schedule.total_steps - 1
    for step in (0, half, last):
        run_step(trainer, step)
    fallen = 10.0 ** -((last / (2 * half) - 0.5) / 0.5)
    assert weights == pytest.approx([0.01, 0.01, 0.01 * fallen])


@pytest.mark.parametrize("error", [OSError("no route"), RuntimeError("broken file"), ModuleNotFoundError("lpips")])
def test_lpips_is_left_out_with_a_message_where_its_weights_are_not_available(
    trained, model, monkeypatch, capsys, error
):
    calls = []

    def refuse(*args, **kwargs):
        calls.append(kwargs)
        raise error

    monkeypatch.setattr(torchmetrics.image.lpip, "LearnedPerceptualImagePatchSimilarity", refuse)
    monkeypatch.setattr(model, "metrics", ImageMetrics(model.metrics.lpips_net))
    camera, batch = trained.pipeline.datamanager.next_eval_image(0)
    outputs = model.get_outputs_for_camera(camera)
    for _ in range(2):
        values, images = model.get_image_metrics_and_images(outputs, batch)
        assert set(values) == {"psnr", "ssim", "cc_psnr", "field_psnr", "field_ssim", "dropped_mass"}
        assert all(isinstance(v, float) and np.isfinite(v) for v in values.values())
    assert len(calls) == 1, "one attempt is enough"
    assert "LPIPS is left out" in " ".join(capsys.readouterr().out.split())
    assert set(images) == {"img", "accumulation", "inverse_depth", "winning_mpi"}
    for name, image in images.items():
        assert image.shape == (HEIGHT, WIDTH * (2 if name == "img" else 1), 3), name
        assert image.min() >= 0 and image.max() <= 1
