"""Poses refined during training and before scoring: what moves, what is kept, what is exported, what is refused."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.lie_groups import exp_map_SO3xR3
from nerfstudio.utils.eval_utils import eval_setup
from refined import refined_camera
from tiny_scene import write_scene
from training_runs import compared, differences, load, ready, trainer_config, write_plan, write_windows

from mmpi_ns.data.rays import TrainingRays, image_rays
from mmpi_ns.rendering.metrics import psnr
from mmpi_ns.training.run import move_rays
from mmpi_ns.utils.errors import InputError

STEPS = 24
OFF = 0.06
"""Radians that a pose is turned by: 1.7 pixels of the tiny scene."""


def refining(scene, plan_file, folder, steps=STEPS, **settings):
    config = trainer_config(scene, plan_file, folder, steps, **settings)
    config.pipeline.model.camera_optimizer.mode = "SO3xR3"
    return config


@pytest.fixture(scope="module")
def whole(scene, plan_file, tmp_path_factory):
    """A run of all phases with refined poses, and config.yml beside it."""
    config = refining(scene, plan_file, tmp_path_factory.mktemp("whole"))
    config.save_config()
    trainer = ready(config)
    trainer.train()
    return trainer


def corrections(folder, step):
    return load(folder, step)["pipeline"]["_model.camera_optimizer.pose_adjustment"]


def test_poses_move_in_every_phase_but_that_of_reliability(whole):
    moved = {step: corrections(whole.checkpoint_dir, step) for step in range(1, STEPS)}
    assert moved[1].shape == (6, 6) and torch.isfinite(moved[STEPS - 1]).all()
    phases = whole.pipeline.model.progress.schedule.phases
    assert [p.name for p in phases] == ["individual", "blend", "finetune"]
    for step in range(2, STEPS):
        still = phases[1].start <= step < phases[1].end
        assert torch.equal(moved[step], moved[step - 1]) == still


@pytest.mark.parametrize("step", [5, 14, 20])
def test_a_resumed_run_refines_as_the_uninterrupted_one(whole, scene, plan_file, tmp_path, step):
    trainer = ready(refining(scene, plan_file, tmp_path), load_dir=whole.checkpoint_dir, load_step=step)
    trainer.train()
    wanted, actual = (load(t.checkpoint_dir, STEPS - 1) for t in (whole, trainer))
    assert differences(compared(wanted), compared(actual)) == []


@pytest.mark.parametrize("refines", [False, True])
def test_a_checkpoint_with_other_refinement_is_refused(whole, scene, plan_file, tmp_path, refines):
    folder = whole.checkpoint_dir
    if refines:
        state = load(folder, 1)
        del state["pipeline"]["_model.camera_optimizer.pose_adjustment"]
        folder = tmp_path / "models"
        folder.mkdir()
        torch.save(state, folder / "step-000000001.ckpt")
    config = (refining if refines else trainer_config)(scene, plan_file, tmp_path)
    said = "unrefined poses: .* off" if refines else "with refined poses: .* SO3xR3"
    with pytest.raises(InputError, match=said):
        ready(config, load_dir=folder, load_step=1)


def test_exported_cameras_are_the_given_ones_with_their_corrections(whole, monkeypatch):
    """What ``ns-export cameras`` writes of a run, as it loads it."""
    monkeypatch.setitem(sys.modules, "open3d", MagicMock())  # cannot be imported everywhere, and has no part in this
    from nerfstudio.exporter.exporter_utils import collect_camera_poses

    _, pipeline, _, _ = eval_setup(whole.base_dir / "config.yml")
    frames, tests = collect_camera_poses(pipeline)
    actual = torch.tensor([frame["transform"] for frame in frames])
    given = whole.pipeline.datamanager.train_dataset.cameras.camera_to_worlds
    moves = exp_map_SO3xR3(corrections(whole.checkpoint_dir, STEPS - 1))
    assert torch.allclose(actual[:, :, :3], moves[:, :, :3] @ given[:, :, :3], atol=1e-6)
    assert torch.allclose(actual[:, :, 3], moves[:, :, 3] + given[:, :, 3], atol=1e-6)
    assert (actual - given).abs().max() > 1e-4 and len(tests) == 2
    names = [str(name) for name in whole.pipeline.datamanager.train_dataset.image_filenames]
    assert [frame["file_path"] for frame in frames] == names


def test_a_capture_in_several_windows_is_refused(scene, tmp_path):
    windows = write_windows(scene, tmp_path / "windows.json")
    with pytest.raises(InputError, match=r"trained in 2 windows.*--refine-poses.*window-length 0"):
        ready(refining(scene, windows, tmp_path))


# Poses that are off ---------------------------------------------------------------------------------------------------


def turn(pose, by):
    """A pose [4, 4] turned about the world's axes."""
    turned = np.array(pose)
    move = torch.tensor([[0.0, 0, 0, *by]])
    turned[:3, :3] = exp_map_SO3xR3(move)[0, :, :3].numpy() @ turned[:3, :3]
    return turned.tolist()


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """The tiny scene with one training and one test image turned, trained with refined poses."""
    data = write_scene(tmp_path_factory.mktemp("turned") / "data")
    plan = write_plan(data, data.parent / "plan.json")
    path = data / "transforms.json"
    scene = json.loads(path.read_text())
    for name in (scene["train_filenames"][2], scene["test_filenames"][0]):
        frame = next(f for f in scene["frames"] if f["file_path"] == name)
        frame["transform_matrix"] = turn(frame["transform_matrix"], (0.0, OFF, 0.0))
    path.write_text(json.dumps(scene))
    config = refining(data, plan, data.parent / "out", 300, training="joint")
    config.pipeline.datamanager.train_num_rays_per_batch = 256
    config.steps_per_save = 300
    config.optimizers["camera_opt"]["optimizer"].lr = 3e-4  # of so few steps
    trainer = ready(config)
    trainer.train()
    return trainer


def test_training_turns_a_pose_back(turned):
    moved = turned.pipeline.model.camera_optimizer.pose_adjustment.detach()[:, 3:]
    others = moved[[0, 1, 3, 4, 5]]
    up = turned.pipeline.datamanager.train_dataparser_outputs.dataparser_transform[:, 1]  # the capture's y
    against = (moved[2] - others.mean(0)) @ up
    assert -1.4 * OFF < against < -0.6 * OFF and (others - others.mean(0)).abs().max() < 0.4 * OFF


def test_a_turned_test_image_is_turned_back_against_the_frozen_model(turned):
    pipeline, model = turned.pipeline, turned.pipeline.model
    pipeline.eval()
    data = pipeline.datamanager.eval_dataset
    camera, image = data.cameras[0:1], data.get_image_float32(0)
    moved, degrees, _ = refined_camera(pipeline, camera, image, 0)
    scores = [psnr(model.get_outputs_for_camera(c)["rgb"], image) for c in (camera, moved)]
    assert scores[1] > scores[0] + 0.5 and degrees == pytest.approx(np.degrees(OFF), rel=0.5)
    assert model.field.density.requires_grad, "the field can be trained on"


def test_a_turned_test_image_is_compared_at_its_own_exposure():
    def radiance(bundle):
        x, y = bundle.directions[:, :1], bundle.directions[:, 1:2]
        waves = 0.5 + 0.4 * torch.sin(torch.cat([8 * x, 7 * y, 6 * (x + y)], -1))
        return {"rgb": waves, "radiance": waves}

    exposure, pose, lens = torch.tensor([0.5, 0.6, 0.7]), torch.eye(4)[None, :3], (40.0, 40.0, 16.0, 12.0, 32, 24)
    image = (exposure * radiance(image_rays(Cameras(pose, *lens)).flatten())["rgb"]).view(24, 32, 3)
    turned_pose = pose.clone()
    turned_pose[:, :, :3] = exp_map_SO3xR3(torch.tensor([[0.0, 0, 0, 0, OFF / 3, 0]]))[:, :, :3]
    exposures = SimpleNamespace(mean=torch.ones(3), factors=torch.ones(1, 3), falloff=torch.zeros(2, 3))
    model = SimpleNamespace(device="cpu", exposures=exposures, image_outputs=radiance, parameters=list)
    model.get_outputs_for_camera = lambda _: {}
    maker = SimpleNamespace(exposure_of=lambda *_: exposure)
    pipeline = SimpleNamespace(model=model, datamanager=SimpleNamespace(maker=maker, observations=None))
    moved, degrees, _ = refined_camera(pipeline, Cameras(turned_pose, *lens), image, 0)
    assert torch.allclose(moved.camera_to_worlds[..., :3], pose[..., :3], atol=OFF / 12)
    assert degrees == pytest.approx(np.degrees(OFF / 3), rel=0.25)


@pytest.mark.parametrize("part", ["origins", "directions"])
def test_every_ray_follows_its_camera_and_pixels_of_images_alone_move_it(part):
    poses: CameraOptimizer = CameraOptimizerConfig(mode="SO3xR3").setup(num_cameras=2, device="cpu")
    with torch.no_grad():
        poses.pose_adjustment.copy_(torch.tensor([[0.1, 0.2, 0.3, 0.0, 0.0, 0.2], [0.0, 0.0, -0.5, 0.3, 0.0, 0.0]]))
    numbers, own = torch.tensor([[0], [1], [0], [1]]), torch.tensor([[True], [False], [False], [False]])
    ways = torch.nn.functional.normalize(torch.tensor([[1.0, 2, 3], [3, 1, 2], [1, 0, 0], [0, 1, 1]]), dim=-1)
    given = {"origins": torch.ones(4, 3), "directions": ways}
    bundle = TrainingRays(**given, pixel_area=torch.ones(4, 1), camera_indices=numbers, through_pixel=own)
    move_rays(bundle, poses)
    moves = poses(numbers[:, 0])
    wanted = {
        "origins": given["origins"] + moves[:, :, 3],
        "directions": (moves[:, :, :3] @ given["directions"][..., None])[..., 0],
    }
    assert torch.allclose(getattr(bundle, part), wanted[part]) and not torch.allclose(wanted[part], given[part])
    (getattr(bundle, part) * torch.arange(12.0).view(4, 3)).sum().backward()
    grad = poses.pose_adjustment.grad
    assert grad is not None and grad[0].abs().sum() > 0 and not grad[1].any()
