"""Gains and biases of training images: their values, their gauge, and what they are good for (exposure.py)."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scene import TEST, TRAIN, name_of, write_scene
from training_runs import compared, datamanager, differences, load, plan_of, ready, trainer_config, write_plan

from mmpi_ns.field.shading import RayColors
from mmpi_ns.ops.compositing import Composite, composite_weights, render_colors
from mmpi_ns.scene.windows import Window, WindowedPlan
from mmpi_ns.training.exposure import Exposure, departure, gains_and_biases
from mmpi_ns.training.phases import TRAINS

F64 = torch.float64
GAINS = np.array([1.25, 0.8, 1.1, 0.75, 1.3, 0.8])
"""What the training images were multiplied by; their mean is 1."""
DARKER = 0.7
"""So that none is clipped."""


# Values and gradients ------------------------------------------------------------------------------------------------


def exposed_by_hand(settings, colors, cameras, images):
    """Colours of samples, one number at a time."""
    found = colors.copy()
    for r, camera in enumerate(cameras):
        if camera not in images:
            continue
        for c in range(3):
            total = sum(math.exp(settings[i, 0, c]) for i in images)
            gain = len(images) * math.exp(settings[camera, 0, c]) / total
            bias = settings[camera, 1, c] - sum(settings[i, 1, c] for i in images) / len(images)
            found[r, :, c] = gain * colors[r, :, c] + bias
    return found


def gathered(share, behind, colors):
    """What rays have gathered of samples, ``behind`` times as much of it unseen, and the mass of all."""
    share, behind, colors = (torch.from_numpy(x) for x in (share, behind, colors))
    rgb = (share[..., None] * colors).sum(1) * (1 + behind)
    mass = share.sum(1, keepdim=True) + behind
    return RayColors.of_samples(Composite(share, mass, 1 - mass), rgb, colors), mass


@pytest.mark.parametrize("images", [None, [1, 2, 4]])
def test_colours_and_gradients_are_those_of_the_formula(images):
    rng = np.random.default_rng(0)
    settings, colors = rng.normal(0, 0.5, (5, 2, 3)), rng.random((6, 4, 3))
    cameras = np.array([1, 4, 2, 2, 1, 4]) if images else np.array([0, 3, 1, 2, 4, 0])
    exposure = Exposure(5).double()
    exposure.settings.data = torch.from_numpy(settings)
    exposure.images = None if images is None else torch.tensor(images)
    share, behind = rng.dirichlet(np.ones(5), 6)[:, :4], rng.random((6, 1)) * 0.1
    found = exposure(*gathered(share, behind, colors), torch.from_numpy(cameras))
    used = range(5) if images is None else images

    def by_hand(settings):
        """What the samples' own colours come to: what rays show, and both sums for the loss of points."""
        exposed, w = exposed_by_hand(settings, colors, cameras, used), share[..., None]
        ones = exposed_by_hand(settings, np.ones_like(colors), cameras, used)[:, 0]
        zeros = exposed_by_hand(settings, np.zeros_like(colors), cameras, used)[:, 0]
        shown = (w * colors).sum(1) * (1 + behind) * (ones - zeros) + zeros * (share.sum(1, keepdims=True) + behind)
        return np.concatenate([shown, (w * exposed).sum(1), (w * exposed**2).sum(1)], -1)

    values = torch.cat([found.rgb, found.first, found.second], -1)
    np.testing.assert_allclose(values.detach(), by_hand(settings), rtol=1e-12)
    weights = rng.normal(size=values.shape)
    (values * torch.from_numpy(weights)).sum().backward()
    for place in np.ndindex(5, 2, 3):
        sides = []
        for shift in (1e-6, -1e-6):
            moved = settings.copy()
            moved[place] += shift
            sides.append((by_hand(moved) * weights).sum())
        assert exposure.settings.grad[place].item() == pytest.approx((sides[0] - sides[1]) / 2e-6, abs=1e-7)


def test_gains_have_mean_one_and_biases_mean_zero_whatever_the_settings():
    gains, biases = gains_and_biases(torch.randn(7, 2, 3, dtype=F64, generator=torch.Generator().manual_seed(1)) * 3)
    assert torch.allclose(gains.mean(0), torch.ones(3, dtype=F64)) and (gains > 0).all()
    assert torch.allclose(biases.mean(0), torch.zeros(3, dtype=F64), atol=1e-12)
    assert departure(gains, biases) > 1 and departure(*gains_and_biases(torch.full((4, 2, 3), 0.7))) == 0


def test_images_of_other_windows_are_outside_the_gauge_and_get_no_gradient():
    exposure = Exposure(4)
    exposure.settings.data.normal_(generator=torch.Generator().manual_seed(2))
    exposure.images = torch.tensor([0, 3])
    gains, biases = exposure.gains_and_biases()
    assert torch.allclose(gains.mean(0), torch.ones(3)) and torch.allclose(biases.mean(0), torch.zeros(3), atol=1e-6)
    colors, mass = gathered(np.full((5, 2), 0.3), np.full((5, 1), 0.1), np.random.default_rng(0).random((5, 2, 3)))
    exposure(colors, mass, torch.tensor([0, 3, 3, 0, 0])).rgb.square().sum().backward()
    assert (exposure.settings.grad[[0, 3]] != 0).all() and not exposure.settings.grad[[1, 2]].any()


def test_what_lies_behind_a_ray_is_not_exposed():
    """A background enters as it is, whether random or observed, and a ray that gathers nothing shows that alone."""
    tau = torch.tensor([[0.0, 0.0], [0.4, 0.9], [30.0, 0.1]], dtype=F64)
    composite = composite_weights(tau, tau > 0, torch.zeros_like(tau), torch.zeros(3, 1, dtype=F64))
    colors, gains, biases = torch.rand(3, 2, 3, dtype=F64), torch.full((3, 3), 1.7, dtype=F64), torch.full((3, 3), 0.2)
    plain = render_colors(composite, colors)
    exposed = RayColors.of_samples(composite, plain, colors).exposed(composite.accumulation, gains, biases.double()).rgb
    torch.testing.assert_close(exposed, 1.7 * plain + 0.2 * composite.accumulation)
    assert not exposed[0].any()


# Off ----------------------------------------------------------------------------------------------------------------


def test_off_there_is_nothing_of_it(scene, plan_file, tmp_path):
    trainer = ready(trainer_config(scene, plan_file, tmp_path, 2))
    trainer.train()
    state = load(trainer.checkpoint_dir, 1)
    assert not [k for k in state["pipeline"] if "exposure" in k]
    assert all("exposure" not in state[k] for k in ("optimizers", "schedulers"))
    model = trainer.pipeline.model
    groups = {"density", "features", "colour", "reliability"}
    assert model.exposure is None and set(model.get_param_groups()) == groups
    _, losses, _ = trainer.pipeline.get_train_loss_dict(0)
    assert "exposure" not in losses


def test_a_config_from_before_it_has_none(scene, plan_file, tmp_path):
    """config.yml holds the settings of its time: those that came later are absent from it."""
    config = trainer_config(scene, plan_file, tmp_path, 2)
    del config.pipeline.model.__dict__["exposure"], config.pipeline.model.loss.__dict__["exposure"]
    assert ready(config).pipeline.model.exposure is None


# On -----------------------------------------------------------------------------------------------------------------


def test_it_trains_while_colours_do_and_is_frozen_while_reliability_learns(scene, plan_file, tmp_path):
    trainer = ready(trainer_config(scene, plan_file, tmp_path, 24, exposure=True))
    trainer.train()
    schedule = trainer.pipeline.model.schedule
    states = [load(trainer.checkpoint_dir, s)["pipeline"]["_model.exposure.settings"] for s in range(1, 24)]
    for step in range(2, 24):
        learns = "colour" in TRAINS[schedule.phase_at(step).name]
        assert torch.equal(states[step - 1], states[step - 2]) != learns, step
    rates = [load(trainer.checkpoint_dir, s)["optimizers"]["exposure"]["param_groups"][0]["lr"] for s in (10, 14)]
    assert rates[0] > 0 and rates[1] == 0


@pytest.mark.parametrize("step", [5, 11, 14])
def test_a_resumed_run_ends_as_the_uninterrupted_one(scene, plan_file, tmp_path, step):
    whole = ready(trainer_config(scene, plan_file, tmp_path / "whole", 24, exposure=True))
    whole.train()
    resumed = ready(
        trainer_config(scene, plan_file, tmp_path / "resumed", 24, exposure=True),
        load_dir=whole.checkpoint_dir,
        load_step=step,
    )
    resumed.train()
    wanted, found = (load(t.checkpoint_dir, 23) for t in (whole, resumed))
    assert differences(compared(wanted), compared(found)) == []
    assert wanted["pipeline"]["_model.exposure.settings"].any()


@pytest.mark.parametrize("there", [True, False])
def test_turning_it_on_or_off_on_the_way_is_refused_in_one_sentence(scene, plan_file, tmp_path, there):
    trainer = ready(trainer_config(scene, plan_file, tmp_path / "a", 2, exposure=there))
    trainer.train()
    config = trainer_config(scene, plan_file, tmp_path / "b", 2, exposure=not there)
    with pytest.raises(ValueError, match=f"resume with --pipeline.model.exposure {there}") as error:
        ready(config, load_dir=trainer.checkpoint_dir)
    assert "\n" not in str(error.value)


def test_each_window_has_a_gauge_of_its_own_and_begins_anew(scene, tmp_path):
    observations = datamanager(scene, test_mode="inference").observations
    plan = plan_of(observations, num_mpis=1)
    left, right = observations.centers[np.argsort(observations.centers @ observations.mean_axes[0])][[0, -1]]
    radius = 0.55 * float(np.linalg.norm(right - left))
    windows = tuple(Window(tuple(c.tolist()), radius, 0.1 * radius, plan) for c in (left, right))
    path = tmp_path / "plan.json"
    path.write_text(WindowedPlan(windows).to_json())
    trainer = ready(trainer_config(scene, path, tmp_path, 6, training="joint", exposure=True))
    trainer.train()
    for window in (0, 1):
        state = load(trainer.checkpoint_dir, 6 * window + 5)
        moved = state["pipeline"]["_model.exposure.settings"].flatten(1).any(-1)
        own = trainer.pipeline.model.cameras_of(observations.centers, window)
        assert moved.nonzero()[:, 0].tolist() == own.tolist() and 0 < len(own) < len(TRAIN)
        assert state["optimizers"]["exposure"]["state"][0]["step"] == 6


# What it is good for ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def changing(tmp_path_factory):
    """The tiny scene, its training images multiplied by ``GAINS``; those to test with are not."""
    data = write_scene(tmp_path_factory.mktemp("changing") / "scene")
    for i in range(8):
        factor = DARKER * (1.0 if i in TEST else GAINS[TRAIN.index(i)])
        path = data / "images" / name_of(i)
        pixels = np.asarray(Image.open(path)) * factor
        assert pixels.max() < 255
        Image.fromarray(pixels.round().astype(np.uint8)).save(path)
    names = json.loads((data / "transforms.json").read_text())["train_filenames"]
    assert names == [f"images/{name_of(i)}" for i in TRAIN]
    return data


def psnr_of_test_images(trainer) -> float:
    trainer.pipeline.eval()
    errors = []
    for camera, batch in trainer.pipeline.datamanager.fixed_indices_eval_dataloader:
        outputs = trainer.pipeline.model.get_outputs_for_camera(camera)
        errors.append(((outputs["rgb"] - batch["image"]) ** 2).mean())
    assert len(errors) == len(TEST)
    return float(-10 * torch.log10(torch.stack(errors).mean()))


def test_images_of_changing_exposure_are_explained_and_the_gains_found(changing, tmp_path):
    plan = write_plan(changing, tmp_path / "plan.json", num_mpis=1)
    found = {}
    for on in (False, True):
        config = trainer_config(changing, plan, tmp_path / str(on), 300, training="joint", exposure=on)
        config.steps_per_save = 1000
        config.pipeline.datamanager.train_num_rays_per_batch = 256
        trainer = ready(config)
        trainer.train()
        found[on] = psnr_of_test_images(trainer)
    assert found[True] > found[False] + 2, found
    gains, _ = trainer.pipeline.model.exposure.gains_and_biases()
    np.testing.assert_allclose(gains.detach().numpy(), np.tile(GAINS[:, None], 3), atol=0.1)
