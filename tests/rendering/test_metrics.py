"""Pictures that are kept beside metrics."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from mmpi_ns.rendering import metrics
from mmpi_ns.rendering.metrics import ImageMetrics, pictures, psnr, ssim
from mmpi_ns.rendering.pipeline import MMPIPipeline


def ssim_of(a, b):
    """SSIM of whole images, by its formula with a Gaussian of 1.5 pixels in windows of 11, mirrored. Float64."""
    a, b = (np.pad(x, ((5, 5), (5, 5), (0, 0)), "reflect") for x in (a, b))

    def mean(x):
        return gaussian_filter(x, (1.5, 1.5, 0), truncate=5 / 1.5, mode="constant")[5:-5, 5:-5]

    mean_a, mean_b = mean(a), mean(b)
    cov, var = mean(a * b) - mean_a * mean_b, mean(a * a) - mean_a**2 + mean(b * b) - mean_b**2
    near, like = 2 * mean_a * mean_b + 1e-4, 2 * cov + 9e-4
    return (near * like / ((mean_a**2 + mean_b**2 + 1e-4) * (var + 9e-4))).mean()


@pytest.mark.parametrize("part", [1, 700, 1 << 20])
@pytest.mark.parametrize("shape", [(37, 53), (11, 64), (64, 11)])
def test_scores_do_not_depend_on_the_parts_in_which_images_are_compared(part, shape, monkeypatch):
    monkeypatch.setattr(metrics, "PART", part)
    rng = np.random.default_rng(0)
    b = rng.random((*shape, 3))
    a = (0.8 * b + 0.2 * rng.random((*shape, 3)) * b[::-1]).clip(0, 1)
    predicted, observed = torch.from_numpy(a), torch.from_numpy(b)
    assert ssim(predicted, observed) == pytest.approx(ssim_of(a, b), abs=1e-5)
    assert psnr(predicted, observed) == pytest.approx(-10 * np.log10(((a - b) ** 2).mean()), abs=1e-9)


def test_a_grey_image_has_no_score_with_fitted_colours():
    """``ns-eval`` ended in a traceback on a grey capture."""
    noise = torch.rand(40, 50, 3, generator=torch.Generator().manual_seed(0))
    scores = [ImageMetrics("none")(image, noise) for image in (torch.full_like(noise, 0.4), 0.9 * noise)]
    assert ["cc_psnr" in each for each in scores] == [False, True]


def test_pictures_of_more_pixels_than_torch_sorts_are_made():
    side = 4097
    assert side**2 > 1 << 24
    row = torch.linspace(0.5, 2.0, side)
    one = torch.zeros(1, 1, 1)
    outputs = {
        "depth": (1 / row)[None, :, None].expand(side, side, 1), "rgb": one.expand(side, side, 3),
        "accumulation": one.expand(side, side, 1), "winning_mpi": one.long().expand(side, side, 1),
    }  # fmt: skip
    rendered = pictures(one.expand(side, side, 3), outputs, 2)["inverse_depth"]
    brightest = torch.quantile(row, 0.98)
    assert torch.allclose(rendered[1234, :, 0], (row / brightest).clamp(max=1), atol=1e-3)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_score_that_an_image_lacks_is_the_mean_over_the_others(order):
    """A depth image may be empty, and an image too small for SSIM."""
    scores = [{"psnr": 20.0, "depth_error": 0.1, "ssim": 0.5}, {"psnr": 22.0}]
    loader, pipeline = MagicMock(), MagicMock()
    loader.input_dataset.image_filenames = ["a.png", "b.png"]
    camera = SimpleNamespace(width=4, height=3)
    loader.__iter__.side_effect = lambda: iter([(camera, {"image_idx": i}) for i in order])
    pipeline.score.side_effect = lambda _, batch: (dict(scores[batch["image_idx"]]), {})
    means = MMPIPipeline.get_average_image_metrics(pipeline, loader, "eval", get_std=True)
    assert (means["psnr"], means["depth_error"], means["ssim"]) == (21.0, 0.1, 0.5) and means["depth_error_std"] == 0
