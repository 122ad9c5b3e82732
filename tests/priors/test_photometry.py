"""Gains of images from the colours of surfaces that several of them show."""

from __future__ import annotations

import numpy as np
import pytest

from mmpi_ns.data.priors import Gains
from mmpi_priors.photometry import ColorRatios, ExposedView, exposure_by, grouped, image_gains, joined, solve

CONSTANT, FLAT = np.zeros((12, 3)), np.zeros((2, 3))


def drive(logs, *, falloff=(0.0, 0.0), noise=0.02, seed=0, neighbours=3, outliers=0.0):
    """Ratios of a straight drive: in a later image every surface is farther from the middle."""
    rng, parts = np.random.default_rng(seed), []
    for i in range(len(logs)):
        for j in range(i + 1, min(i + 1 + neighbours, len(logs))):
            before = rng.uniform(0, 0.8, 800)
            after = before * (1 + 0.25 * (j - i)) + rng.normal(0, 0.01, 800)
            seen = after < 1
            change = np.stack([after - before, after**2 - before**2], -1)[seen]
            ratio = logs[j] - logs[i] + (change @ np.array(falloff))[:, None] + rng.normal(0, noise, (len(change), 3))
            wrong = rng.random(len(ratio)) < outliers
            ratio[wrong] += rng.normal(0.3, 0.3, (wrong.sum(), 3))
            parts.append(grouped(i, j, ratio, (before[seen], after[seen])))
    return joined(parts)


def wandering(count=12, seed=1):
    logs = np.random.default_rng(seed).normal(0, 0.15, (count, 3)).cumsum(0)
    return logs - logs.mean(0)


def test_known_gains_are_recovered_within_their_errors():
    truth = wandering()
    logs, errors, _ = solve(drive(truth), 12)
    assert np.abs(logs - truth).max() < 0.03
    assert (np.abs(logs[:, 1] - truth[:, 1]) < 4 * errors).all()


def test_false_matches_do_not_change_gains():
    truth = wandering()
    logs, *_ = solve(drive(truth, outliers=0.25), 12)
    assert np.abs(logs - truth).max() < 0.05


def test_falloff_towards_the_corners_does_not_pose_as_exposure():
    gains = image_gains(drive(CONSTANT, falloff=(-0.5, -0.2)), 12)
    assert not gains.matter
    assert np.abs(np.log(gains.factors)).max() < 0.03


def test_falloff_and_gains_are_told_apart():
    truth = wandering()
    logs, _, falloff = solve(drive(truth, falloff=(-0.5, -0.2)), 12)
    assert np.abs(logs - truth).max() < 0.05
    assert np.abs(falloff.sum(0) + 0.7).max() < 0.1


def test_constant_exposure_is_left_alone():
    assert not image_gains(drive(CONSTANT, noise=0.08), 12).matter


def test_changing_exposure_is_corrected():
    gains = image_gains(drive(wandering()), 12)
    assert gains.matter
    assert gains.corrected < 0.3 * gains.disagreement
    assert image_gains(drive(wandering()), 14).matter  # beside two images, black ones say, that match none


def test_exif_ties_images_that_no_match_connects():
    truth = np.repeat(0.45 * np.log(np.array([1, 1.2, 1.1, 3, 3.3, 2.8]))[:, None], 3, 1)
    halves = [drive(truth[:3]), drive(truth[3:])]
    second = halves[1]
    second = ColorRatios(second.first + 3, second.second + 3, second.log_ratios, second.errors, second.falloff)
    ratios = joined([halves[0], second])
    exposures = np.array([1, 1.2, 1.1, 3, 3.3, 2.8])
    without, (logs, *_) = solve(ratios, 6)[0], solve(ratios, 6, exposures)
    step = truth[3:].mean() - truth[:3].mean()
    assert abs(without[3:].mean() - without[:3].mean()) < 0.5 * step
    assert abs(logs[3:].mean() - logs[:3].mean() - step) < 0.15 * step


def test_clipped_windows_and_borders_are_left_out():
    image = np.full((40, 40, 3), 128, np.uint8)
    image[20, 20] = 255
    image[30, 5, 1] = 3
    usable = np.ones((40, 40), np.uint8)
    usable[12, 30] = 0
    view = ExposedView.of(image, usable, None, 0)
    mean, exposed = view.colors, view.exposed
    assert not exposed[10:15, 28:33].any()
    assert not exposed[18:23, 18:23].any() and not exposed[28:33, 3:8].any()
    assert not exposed[:2].any() and not exposed[:, -2:].any()
    assert exposed[10, 10] and mean[10, 10] == pytest.approx(128 / 255)


def test_gains_that_are_uncertain_explain_little_or_hardly_vary_do_not_matter():
    factors, sure, unsure = (
        np.exp(np.linspace(-0.2, 0.2, 11))[:, None].repeat(3, 1),
        np.full(11, 0.01),
        np.full(11, 0.1),
    )
    assert Gains(factors, sure, FLAT, 0.1, 0.02).matter
    assert Gains(factors ** [1, 0, -1], sure, FLAT, 0.1, 0.02).matter, "white balance leaves green as it is"
    assert not Gains(factors, unsure, FLAT, 0.1, 0.02).matter and not Gains(factors, sure, FLAT, 0.187, 0.18).matter
    assert not Gains(np.ones((11, 3)), unsure, FLAT, 0.01, 0.002).matter


def test_falloff_is_taken_out_of_an_uncalibrated_image():
    """log(second / first) = k_second - k_first + falloff (r_second - r_first), solved for the first."""
    falloff, change = np.array([[-0.5] * 3, [-0.2] * 3]), np.array([[0.3, 0.1]])
    own, other = np.log([1.5, 1.2, 0.9]), np.log([0.8, 1.0, 1.1])
    ratios = ColorRatios(np.array([9]), np.array([1]), other - own + change @ falloff, np.array([0.01]), change)
    exposures = np.exp(np.stack([np.zeros(3), other]))
    np.testing.assert_allclose(exposure_by(ratios, exposures, falloff), [1.5, 1.2, 0.9])
