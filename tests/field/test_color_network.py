"""The colour networks of samples against their formula in float64."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from compiled import normal

from mmpi_ns.field.shading import ColorNetworks


def encoded(x, octaves):
    angles = [math.pi * 2**i * x for i in range(octaves)]
    return torch.cat([x, *(a.sin() for a in angles), *(a.cos() for a in angles)], -1)


def by_formula(networks, head, features, ndc, directions, rays, octaves):
    """sigmoid(features + network(features, PE(ndc), PE(direction))), from the pooled numbers."""
    numbers, layers, at = networks.weights[min(head, len(networks.weights) - 1)].double(), [], 0
    sizes = (features.shape[1] + 3 * (1 + 2 * octaves[0]) + 3 * (1 + 2 * octaves[1]), networks.width, networks.width, 3)
    for inputs, outputs in pairwise(sizes):
        matrix = numbers[at : at + inputs * outputs].view(outputs, inputs)
        layers.append((matrix, numbers[at + inputs * outputs : at + (inputs + 1) * outputs]))
        at += (inputs + 1) * outputs
    x = torch.cat([features, encoded(ndc.double(), octaves[0]), encoded(directions.double()[rays], octaves[1])], -1)
    for i, (matrix, bias) in enumerate(layers):
        x = (matrix @ x[..., None])[..., 0] + bias
        x = x.clamp(min=0) if i < 2 else x
    return 1 / (1 + torch.exp(-(features[:, :3] + x)))


def batch(channels, width, octaves, count):
    """Networks, and samples of one head."""
    networks = ColorNetworks(3, channels, width, *octaves)
    networks.weights.data = normal(*networks.weights.shape, seed=1) * 0.4
    g = torch.Generator().manual_seed(count)
    directions = torch.nn.functional.normalize(normal(60, 3, seed=2), dim=-1)
    ndc, rays = torch.rand(count, 3, generator=g) * 2 - 1, torch.randint(60, (count,), generator=g)
    return networks, normal(count, channels, seed=3), ndc, directions, rays


@pytest.mark.parametrize("count", [0, 1, 3079])
@pytest.mark.parametrize(
    ("channels", "width", "octaves"), [(3, 5, (0, 0)), (9, 32, (2, 2)), (17, 64, (4, 1)), (4, 40, (1, 0))]
)
def test_colours_and_their_gradients_equal_float64(channels, width, octaves, count):
    networks, features, *places = batch(channels, width, octaves, count)
    ndc, directions, rays = places
    given, exact, grad = features.clone().requires_grad_(), features.double().requires_grad_(), normal(count, 3, seed=4)
    actual = networks.shade([1], [count], given, *places)
    wanted = by_formula(networks, 1, exact, ndc, directions, rays, octaves)
    assert actual.shape == (count, 3) and torch.allclose(actual.double(), wanted, atol=2e-6)
    sums = [(actual * grad).sum(), (wanted * grad).sum()]
    mine = torch.autograd.grad(sums[0], [given, networks.weights])
    truth = torch.autograd.grad(sums[1], [exact, networks.weights])
    for a, b in zip(mine, truth, strict=True):
        assert torch.allclose(a.double(), b.double(), rtol=0, atol=float(4e-6 * (1 + b.double().norm())))
    assert not mine[1][[0, 2]].any()


def test_encoded_once_a_ray_or_once_a_sample_a_direction_gives_the_same_colour():
    networks, features, ndc, directions, rays = batch(4, 8, (2, 2), 6)
    once = networks.shade([1], [6], features, ndc, directions, rays)
    each = networks.shade([1], [6], features, ndc, directions[rays], torch.arange(6))
    assert torch.allclose(once, each, atol=1e-7)


def test_colours_say_where_a_feature_is_not_a_number():
    networks, features, *places = batch(9, 32, (2, 2), 40)
    features[7, 5] = math.nan
    assert networks.shade([1], [len(features)], features, *places).isnan().any(-1).nonzero().flatten().tolist() == [7]


def test_colours_and_gradients_have_the_same_bits_for_any_number_of_threads(three_threads):
    networks, features, *places = batch(9, 32, (2, 2), 3079)

    def results():
        given = features.clone().requires_grad_()
        colors = networks.shade([0], [len(given)], given, *places)
        return colors, *torch.autograd.grad((colors * normal(*colors.shape, seed=4)).sum(), [given, networks.weights])

    several = results()
    torch.set_num_threads(1)
    assert all(a.equal(b) for a, b in zip(several, results(), strict=True))
