"""The compiled colour networks against plain torch and float64."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from compiled import both, compiled, normal  # noqa: F401
from random_fields import bundle, random_field, random_rays

from mmpi_ns.field.color_network import ColorNetworks
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.colors import PART as COLOUR_PART
from mmpi_ns.ops.colors import colors
from mmpi_ns.rendering.sampler import MMPISampler


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(("channels", "width", "octaves"), [(3, 5, (0, 0)), (9, 32, (2, 2)), (4, 64, (4, 1))])
def test_shading_equals_the_colour_networks(channels, width, octaves, shared):
    plan = random_field(4, True, seed=7).plan
    field = MMPIField(
        plan,
        feature_channels=channels,
        hidden_width=width,
        position_frequencies=octaves[0],
        direction_frequencies=octaves[1],
        shared_colour=shared,
    ).eval()
    field.features.data = normal(*field.features.shape, seed=1) * 2
    field.networks.weights.data = normal(*field.networks.weights.shape, seed=2) * 0.3
    rays = bundle(*random_rays(plan, 60, seed=8))
    samples, _ = MMPISampler()(rays, field=field, threshold=0.0)
    assert samples.metadata["heads"].unique().numel() == 5
    with torch.no_grad():
        fast, plain = both(lambda: next(iter(field.get_outputs(samples).values())))
    assert plain.std() > 0.05 and (fast - plain).abs().max() < 5e-6
    assert (fast[~samples.metadata["valid"][..., 0]] == 0).all()


def test_encoded_once_a_ray_or_once_a_sample_a_direction_gives_the_same_colour():
    networks = ColorNetworks(2, 4, 8, 2, 2)
    networks.weights.data = normal(*networks.weights.shape)
    features, ndc, directions, rays = normal(6, 4), normal(6, 3), normal(3, 3), torch.tensor([2, 0, 0, 1, 2, 2])
    once, each = networks(1, features, ndc, directions, rays), networks(1, features, ndc, directions[rays])
    assert torch.allclose(once, each, atol=1e-7)


def colour_batch(channels, width, octaves, count):
    """Networks and samples of one head; the samples of a ray follow each other, and some rays have many, some none."""
    networks = ColorNetworks(3, channels, width, *octaves)
    networks.weights.data = normal(*networks.weights.shape, seed=1) * 0.4
    g = torch.Generator().manual_seed(count)
    rays = (torch.rand(count, generator=g) ** 3 * 60).long().sort()[0]
    directions = torch.nn.functional.normalize(normal(60, 3, seed=2), dim=-1)
    return networks, normal(count, channels, seed=3), torch.rand(count, 3, generator=g) * 2 - 1, directions, rays


def colours_and_gradients(function, batch, dtype=torch.float32):
    networks, features, ndc, directions, rays = batch
    networks = copy.deepcopy(networks).to(dtype)
    features = features.detach().to(dtype).requires_grad_()
    found = function(networks, 1, features, ndc.to(dtype), directions.to(dtype), rays)
    (found * normal(len(rays), 3, seed=4).to(dtype)).sum().backward()
    return found.detach(), features.grad, networks.weights.grad


@pytest.mark.parametrize("count", [1, 33, 5000])
@pytest.mark.parametrize(
    ("channels", "width", "octaves"), [(3, 5, (0, 0)), (9, 32, (2, 2)), (17, 64, (4, 1)), (4, 40, (1, 0))]
)
def test_colours_and_their_gradients_equal_float64(channels, width, octaves, count):
    batch = colour_batch(channels, width, octaves, count)
    found = colours_and_gradients(colors, batch)
    wanted = colours_and_gradients(ColorNetworks.forward, batch, torch.float64)
    assert wanted[0].std() > 0.05
    for a, b in zip(found, wanted, strict=True):
        assert (a.double() - b).abs().max() < 2e-6 * (1 + b.abs().max())
    assert (wanted[2][1] != 0).float().mean() > 0.2 and not found[2][[0, 2]].any()


def test_gradients_of_colours_do_not_depend_on_the_number_of_threads():
    batch, threads, found = colour_batch(9, 32, (2, 2), 9000), torch.get_num_threads(), []
    for count in (1, 3):
        try:
            torch.set_num_threads(count)
            found.append(colours_and_gradients(colors, batch))
        finally:
            torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_one_ray_of_more_samples_than_a_part_has_all_its_gradient():
    networks, features, ndc, directions, rays = colour_batch(9, 32, (2, 2), 9000)
    batch = (networks, features, ndc, directions, torch.where(rays < 8, 2, rays).sort()[0])
    assert (batch[4] == 2).sum() > 2 * COLOUR_PART
    found = colours_and_gradients(colors, batch)
    for a, b in zip(found, colours_and_gradients(ColorNetworks.forward, batch, torch.float64), strict=True):
        assert (a.double() - b).abs().max() < 2e-6 * (1 + b.abs().max())


def test_colours_say_where_a_feature_is_not_a_number():
    networks, features, ndc, directions, rays = colour_batch(9, 32, (2, 2), 40)
    features[7, 5] = math.nan
    found, to_features, to_weights = colours_and_gradients(colors, (networks, features, ndc, directions, rays))
    assert found.isnan().any(-1).nonzero().flatten().tolist() == [7]
    assert to_features[7].isnan().all() and to_features.isnan().sum() == 9 and to_weights[1].isnan().any()


def test_colours_and_gradients_stay_float32_under_autocast():
    batch = colour_batch(9, 32, (2, 2), 300)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = colours_and_gradients(colors, batch)
    assert all(a.dtype == torch.float32 for a in found)
    assert (found[0] - colours_and_gradients(colors, batch)[0]).abs().max() < 0.03


def test_without_samples_colours_have_no_gradient():
    found = colours_and_gradients(colors, colour_batch(9, 32, (2, 2), 0))
    assert found[0].shape == (0, 3) and found[1].shape == (0, 9) and not found[2].any()
