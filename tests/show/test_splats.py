"""Splats: the file's layout, where a plane's splats lie, merging, and the fit of their colours."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from random_bricks import random_window, scene_of

from mmpi_show import splats
from mmpi_show.files import Pose
from mmpi_show.ops.splat import Gaussians, splat_errors, splat_image


@pytest.fixture(scope="module")
def window():
    """Everything is stored, one colour in each brick; the nearest planes are opaque."""
    actual = random_window(num_mpis=1, planes=8, stored=1.0, density=(200, 255), seed=3)
    for table in (actual.mpis.density, actual.mpis.texels):
        table[:] = table[:, :1, :1]
    return actual


def cameras(window):
    return scene_of(window).path


def read(path):
    """The columns of a file as a viewer finds them, by name."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    table = np.frombuffer(data[end:], "<f4").reshape(-1, len(names))
    assert f"element vertex {len(table)}" in lines
    return dict(zip(names, table.T, strict=True))


def test_the_file_is_what_viewers_read(tmp_path):
    """Positions, logarithms of scales, w x y z, logits of opacity, and harmonics channel by channel."""
    g = torch.Generator().manual_seed(0)
    given = splats.Splats(
        torch.randn(5, 3, generator=g), torch.rand(5, 3, generator=g) + 0.1,
        torch.nn.functional.normalize(torch.randn(5, 4, generator=g), dim=-1),
        torch.rand(5, generator=g) * 0.9 + 0.05, torch.rand(5, 4, 3, generator=g),
    )  # fmt: skip
    size = splats.write_ply(given, tmp_path / "scene.ply")
    assert size == (tmp_path / "scene.ply").stat().st_size
    actual = read(tmp_path / "scene.ply")
    column = lambda *names: np.stack([actual[n] for n in names], -1)  # noqa: E731
    np.testing.assert_array_equal(column("x", "y", "z"), given.means)
    np.testing.assert_allclose(np.exp(column("scale_0", "scale_1", "scale_2")), given.scales, rtol=1e-5)
    np.testing.assert_array_equal(column("rot_0", "rot_1", "rot_2", "rot_3"), given.rotations)
    np.testing.assert_allclose(1 / (1 + np.exp(-actual["opacity"])), given.alphas, rtol=1e-4)
    x, y, z = d = np.array([0.6, 0.0, 0.8])
    basis = 0.4886025119029199 * np.array([-y, z, -x])
    for c in range(3):
        rest = column(*(f"f_rest_{3 * c + i}" for i in range(3)))
        rendered = 0.5 + 0.28209479177387814 * actual[f"f_dc_{c}"] + rest @ basis
        np.testing.assert_allclose(rendered, given.colors[:, 0, c] + given.colors[:, 1:, c].numpy() @ d, atol=1e-5)


def test_a_splat_lies_in_its_plane_where_its_texel_is(window):
    """At every texel's place, flat along the MPI's axis, and as wide as the texels are apart."""
    made = splats.splats_of(window, cameras(window), 0.0, 10**6, rounds=0)
    (mpi,) = window.mpis.mpis
    local = (made.means - torch.tensor(mpi.origin)) @ torch.tensor(mpi.axes).T
    plane = ((1 / local[:, 2] - 1 / mpi.far) / mpi.disparity_step).numpy()
    finite = plane > 0.5
    np.testing.assert_allclose(plane[finite], plane[finite].round(), atol=1e-3)
    u0, u1, v0, v1 = mpi.extent
    x, y = (local[:, 0] / local[:, 2] - u0) / (u1 - u0), (local[:, 1] / local[:, 2] - v0) / (v1 - v0)
    half_texels = 2 * torch.stack([x * (mpi.width - 1), y * (mpi.height - 1)], -1)
    np.testing.assert_allclose(half_texels, half_texels.round(), atol=5e-3)  # merged ones lie between texels
    thin = made.gaussians.covariances @ torch.tensor(mpi.axes)[2]
    assert (thin.norm(dim=-1) < 1e-3 * made.gaussians.covariances.flatten(1).norm(dim=-1)).all()


def test_neighbours_that_agree_become_one(window):
    many = splats.splats_of(replace(window), cameras(window), 0.0, 10**6, rounds=0)
    texels = splats._texels(window, torch.ones(window.mpis.density.shape))
    assert len(texels.places.unique(dim=0)) == len(texels.places) > 1.5 * len(many.means)
    group, level = splats._merged(texels, 0.0, len(texels.places))
    assert level.max() > 0 and torch.bincount(group).max() == 4 ** int(level.max())
    few = splats.splats_of(window, cameras(window), 0.0, 50, rounds=0)
    assert len(few.means) == 50


def test_fitted_colours_come_closer_to_the_window(window):
    """Each round brings images of the splats closer to those of the bricks, also from between the cameras."""
    poses = cameras(window)
    start = splats.splats_of(window, poses, 0.0, 10**6, rounds=0)
    end = splats.splats_of(window, poses, 0.0, 10**6, rounds=4)

    def error(made, pose):
        rendered = splat_image(made.gaussians, pose, colors_from(made, torch.tensor(pose.to_world)[:, 3]))
        target = window.render(*pose.rays())["rgb"].view(*rendered.shape[:2], 3)
        return float((rendered[..., :3] + 0.5 * rendered[..., 3:] - target).square().mean())

    (middle,) = splats.between(poses[:1] + poses[1:], 0.4)[:1]
    small: Pose = replace(middle, size=(24, 16), focal=(20.0, 20.0), center=(12.0, 8.0))
    assert error(end, small) < 0.5 * error(start, small)
    assert error(end, small) < 0.01


def colors_from(made, eye):
    """Colours of all splats, seen from a point."""
    return (made.basis(eye)[:, :, None] * made.colors).sum(1).clamp(0, 1)


# Gaussians seen by a camera, against a renderer in float64 that goes pixel by pixel -----------------------------------

PLACE = torch.eye(4)[:3] + torch.tensor([[0, 0, 0, 0.3], [0, 0, 0, -0.2], [0, 0, 0, 1.0]])
VIEW = Pose(PLACE.tolist(), (19, 13), (15.0, 14.0), (8.2, 7.1))


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
    to_world = np.array(view.to_world)
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
    rendered = torch.from_numpy(image[..., :3])
    sums = splat_errors(gaussians, VIEW, colors, rendered, errors).numpy()
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
    actual = splat_errors(gaussians, VIEW, colors, *given)[:, 4:].numpy()
    assert (expected[:, 1] > 0.1).sum() > 4
    np.testing.assert_allclose(actual, expected, rtol=0.02, atol=0.02)
