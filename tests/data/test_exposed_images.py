"""Images of several exposures, from files to batches, losses and pictures, on the tiny scene."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny_scene import HEIGHT, TRAIN, WIDTH, color_of, expose, write_scene
from training_runs import datamanager, in_capture_frame

from mmpi_ns.data.datamanager import CAPTURE
from mmpi_ns.data.posed_images import posed_images
from mmpi_ns.rendering.rendered import Exposures
from mmpi_ns.training.losses import photometric
from mmpi_priors.photometry import ExposedView, exposure_of_view

FACTORS = np.random.default_rng(3).uniform(0.55, 1.0, (8, 3))


@pytest.fixture(scope="module")
def exposed(tmp_path_factory):
    return expose(write_scene(tmp_path_factory.mktemp("exposed")), FACTORS)


@pytest.fixture(scope="module")
def manager(exposed):
    return datamanager(exposed, new_view_share=1.0)


def test_factors_of_the_training_images_are_recovered(manager, capsys):
    truth = np.log(FACTORS[list(TRAIN)])
    error = np.log(manager.priors.gains.factors) - (truth - truth.mean(0))
    assert np.abs(error).max() < 0.05
    assert manager.train_dataset.metadata[CAPTURE].gains is manager.priors.gains


def test_batches_hold_colours_at_one_exposure_whichever_image_they_come_from(manager):
    rays, batch = manager.next_train(0)
    origins, directions = in_capture_frame(manager, rays.origins.double().numpy(), rays.directions.double().numpy())
    truth, count = color_of(origins, directions), len(batch["image"])
    ratio = batch["image"].numpy() / truth[:count]
    pixels = slice(0, len(batch["indices"]))
    spread = np.abs(ratio[pixels] / np.median(ratio[pixels], 0) - 1)
    assert np.median(spread) < 0.04
    assert np.median(np.abs(ratio[len(batch["indices"]) :] / np.median(ratio[pixels], 0) - 1)) < 0.05, "new views too"
    images = batch["indices"][:, 0]
    own = torch.from_numpy(manager.priors.gains.from_field).float()[images]
    torch.testing.assert_close(rays.exposures[: len(images)], own)


def test_colours_of_the_field_fit_its_range(manager):
    assert manager.priors.gains.from_field.min() >= 1 - 1e-9
    assert manager.next_train(0)[1]["image"].max() <= 1


def test_exposure_of_an_image_without_calibration_is_that_of_what_it_shows(manager):
    cameras = posed_images(manager.observations, manager.train_dataset)
    number, held_out = 2, TRAIN[2]
    truth = FACTORS[held_out] / np.exp(np.log(FACTORS[list(TRAIN)]).mean(0))
    views = [view_of(manager, j) for j in range(len(TRAIN))]
    pixels = np.argwhere(views[number].exposed & (manager.priors.depths.image(number)[..., 0] > 0))
    rays = manager.train_ray_generator(torch.from_numpy(np.insert(pixels, 0, number, 1)))
    distances = 1 / manager.priors.depths.image(number)[pixels[:, 0], pixels[:, 1], :1]
    points = (rays.origins.double() + rays.directions.double() * torch.from_numpy(distances)).numpy()
    others = [view for j, view in enumerate(views) if j != number]
    found = exposure_of_view(
        views[number], others, cameras, pixels, points, manager.priors.gains.factors, manager.priors.gains.falloff
    )
    np.testing.assert_allclose(found, truth, rtol=0.06)
    assert (
        exposure_of_view(views[0], [], cameras, pixels, points, manager.priors.gains.factors, np.zeros((2, 3))) is None
    )


def view_of(manager, i):
    image = manager.train_dataset.get_data(i, image_type="uint8")["image"].numpy()
    return ExposedView.of(image, np.ones((HEIGHT, WIDTH), np.uint8), None, i)


def test_the_loss_is_that_in_the_image():
    predicted, observed = torch.tensor([[0.2, 0.3, 0.4]]), torch.tensor([[0.3, 0.3, 0.3]])
    exposure = torch.tensor([[2.0, 1.0, 0.5]])
    expected = ((exposure * (predicted - observed)) ** 2).mean()
    assert photometric(predicted, observed, exposure).item() == pytest.approx(expected.item())


def test_exposures_travel_with_a_checkpoint(manager):
    model, other = Exposures(manager.priors.gains), Exposures(None)
    other.load_state_dict(model.state_dict())
    torch.testing.assert_close(other.factors, model.factors)
    torch.testing.assert_close(other.mean, model.factors.log().mean(0).exp())
    fresh = Exposures(None)
    fresh.load_state_dict({})
    assert fresh.mean is None
