"""Images of several exposures, from files to batches, losses and pictures, on the tiny scene."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scene import HEIGHT, TEST, TRAIN, WALL, WIDTH, color_of, expose, on_wall, write_scene
from training_runs import datamanager, in_capture_frame

from mmpi_ns.data.datamanager import CAPTURE
from mmpi_ns.training.losses import photometric

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


@pytest.mark.parametrize("dated", [False, True])
def test_white_balance_is_calibrated_where_green_stays_also_at_one_exposure_by_exif(tmp_path, dated):
    """As with a camera whose exposure is locked, and whose white balance is not."""
    factors, exif = FACTORS * [[1, 0, 1]] + [[0, 0.8, 0]], Image.Exif()
    exif[0x8769] = {33434: 0.01, 33437: 1.8, 34855: 100}  # time, f-number, ISO
    data = expose(write_scene(tmp_path / "balanced"), factors)
    for path in (data / "images").iterdir() if dated else ():
        Image.open(path).copy().save(path, exif=exif)
    truth = np.log(factors[list(TRAIN)])
    error = np.log(datamanager(data).priors.gains.factors) - (truth - truth.mean(0))
    assert np.abs(error).max() < 0.08


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
    """Rendered with the depths of its pixels, which are those of the wall."""
    camera, data = manager.eval_dataset.cameras[0:1], manager.eval_dataset[0]
    rays = camera.generate_rays(0)
    scale = manager.train_dataparser_outputs.dataparser_scale
    origins, directions = (x.double().numpy() for x in (rays.origins, rays.directions))
    origins, directions = in_capture_frame(manager, origins.reshape(-1, 3), directions.reshape(-1, 3))
    distance = (WALL - origins[:, 2]) / directions[:, 2]
    shown = on_wall(*(origins + distance[:, None] * directions)[:, :2].T)
    images = (torch.from_numpy(x.reshape(HEIGHT, WIDTH, 1)).float() for x in (scale * distance, shown))
    outputs = dict(zip(("depth", "accumulation"), images, strict=True))
    gains = manager.priors.gains.factors, manager.priors.gains.falloff
    given = *map(torch.from_numpy, gains), camera, data["image"]
    actual = manager.maker.exposure_of(manager.observations, *given, outputs)
    truth = FACTORS[TEST[0]] / np.exp(np.log(FACTORS[list(TRAIN)]).mean(0))
    np.testing.assert_allclose(actual, truth, rtol=0.06)
    nothing = outputs | {"accumulation": torch.zeros(HEIGHT, WIDTH, 1)}
    assert manager.maker.exposure_of(manager.observations, *given, nothing) is None


def test_the_loss_is_that_in_the_image():
    predicted, observed = torch.tensor([[0.2, 0.3, 0.4]]), torch.tensor([[0.3, 0.3, 0.3]])
    exposure = torch.tensor([[2.0, 1.0, 0.5]])
    expected = ((exposure * (predicted - observed)) ** 2).mean()
    assert photometric(predicted, observed, exposure).item() == pytest.approx(expected.item())
