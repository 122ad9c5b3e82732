"""Gaussians seen by a camera against a renderer in float64 that goes pixel by pixel."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from mmpi_show.ops.splat import Gaussians, View, splat_errors, splat_image

VIEW = View(
    torch.eye(4)[:3] + torch.tensor([[0, 0, 0, 0.3], [0, 0, 0, -0.2], [0, 0, 0, 1.0]]),
    (19, 13),
    (15.0, 14.0),
    (8.2, 7.1),
)


def some(count=60, seed=0):
    """Gaussians before, beside and behind the camera, flat and round, faint and opaque."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=g) * torch.tensor([6.0, 5.0, 8.0]) - torch.tensor([3.0, 2.5, 6.5])
    half = torch.randn(count, 3, 3, generator=g) * torch.tensor([0.3, 0.2, 0.002])
    alphas = torch.rand(count, generator=g)
    alphas[:3] = torch.tensor([0.0, 1 / 300, 1.0])
    return Gaussians(means, half @ half.mT, alphas), torch.rand(count, 3, generator=g)


def by_hand(gaussians, view, colors):
    """The image and each Gaussian's weights, one pixel and one Gaussian after the other. [H, W, 4], [H, W, N]"""
    to_world = view.to_world.double().numpy()
    width, height = view.size
    image, weights = np.zeros((height, width, 4)), np.zeros((height, width, len(colors)))
    seen = []
    for i, (mean, covariance) in enumerate(zip(*(x.double().numpy() for x in gaussians[:2]), strict=True)):
        right, up, back = (to_world[:, :3].T @ (mean - to_world[:, 3])).tolist()
        x, y, z = right, -up, -back
        if z <= 0.01:
            continue
        axes = np.stack([to_world[:, 0], -to_world[:, 1], -to_world[:, 2]])
        tx = min(max(x / z, -1.3 * width / 2 / view.focal[0]), 1.3 * width / 2 / view.focal[0])
        ty = min(max(y / z, -1.3 * height / 2 / view.focal[1]), 1.3 * height / 2 / view.focal[1])
        bend = np.array([[view.focal[0], 0, -view.focal[0] * tx], [0, view.focal[1], -view.focal[1] * ty]]) / z @ axes
        middle = view.focal[0] * x / z + view.center[0], view.focal[1] * y / z + view.center[1]
        seen.append((z, i, middle, np.linalg.inv(bend @ covariance @ bend.T + 0.3 * np.eye(2))))
    for row in range(height):
        for column in range(width):
            light = 1.0
            for _, i, (u, v), inverse in sorted(seen, key=lambda s: s[0]):
                away = np.array([column + 0.5 - u, row + 0.5 - v])
                alpha = min(0.99, float(gaussians.alphas[i]) * math.exp(-0.5 * away @ inverse @ away))
                if alpha < 1 / 255:
                    continue
                if light * (1 - alpha) <= 1e-4:
                    break
                weights[row, column, i] = light * alpha
                light *= 1 - alpha
            image[row, column, :3] = weights[row, column] @ colors.double().numpy()
            image[row, column, 3] = light
    return image, weights


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_the_hand_made_renderer(seed):
    gaussians, colors = some(seed=seed)
    expected, weights = by_hand(gaussians, VIEW, colors)
    assert (weights.sum(-1) > 0.5).any() and (expected[..., 3] > 0.5).any()
    image = splat_image(gaussians, VIEW, colors).numpy()
    np.testing.assert_allclose(image, expected, atol=5e-3)  # an alpha at its least to the last bit may count or not
    errors = torch.randn(*expected.shape[:2], 3, generator=torch.Generator().manual_seed(seed))
    shown = torch.from_numpy(image[..., :3])
    sums = splat_errors(gaussians, VIEW, colors, shown, errors).numpy()
    np.testing.assert_allclose(sums[:, :3], np.einsum("hwn,hwc->nc", weights, errors.numpy()), atol=0.03)
    np.testing.assert_allclose(sums[:, 3], weights.sum((0, 1)), atol=0.03)


def test_opacities_agree_with_finite_differences():
    """What the image changes with each opacity, as the hand-made renderer changes, shares out an error."""
    gaussians, colors = some(12, seed=5)
    gaussians = gaussians._replace(alphas=gaussians.alphas.clamp(0.05, 0.9))
    background, step = np.array([0.5, 0.2, 0.9]), 1e-5

    def by_logits(logits):
        image, _ = by_hand(gaussians._replace(alphas=torch.sigmoid(logits)), VIEW, colors)
        return image[..., :3] + image[..., 3:] * background

    logits = torch.logit(gaussians.alphas.double())
    moves = step * torch.eye(len(logits), dtype=torch.float64)
    slopes = np.stack([(by_logits(logits + m) - by_logits(logits - m)) / (2 * step) for m in moves], -1)
    slopes[np.abs(slopes) > 1] = 0  # an alpha that became too faint in between
    errors = np.random.default_rng(0).normal(size=slopes.shape[:3])
    parts = slopes * errors[..., None] / np.maximum(np.abs(slopes).sum(-1, keepdims=True), 1e-6)
    expected = np.stack([parts.sum((0, 1, 2)), np.abs(slopes).sum((0, 1, 2))], -1)
    given = (torch.tensor(x, dtype=torch.float32) for x in (by_logits(logits), errors))
    found = splat_errors(gaussians, VIEW, colors, *given)[:, 4:].numpy()
    assert (expected[:, 1] > 0.1).sum() > 4
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.02)
