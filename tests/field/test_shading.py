"""A ray shaded once: the whole path against loops in float64, its gradients, and rays at the borders (shading.py)."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from random_fields import CLEAR, ERROR, OracleRay, bundle, fill, random_field, random_plan, random_rays, sampled

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.shading import RayShader, change_odds
from mmpi_ns.ops import dispatch
from mmpi_ns.ops.composite import composite_weights

F64 = torch.float64


def ray_field(num_mpis=3, with_cube=True, seed=0, channels=7, **chosen):
    plan = random_plan(num_mpis, with_cube, seed)
    field = MMPIField(plan, shading="ray", feature_channels=channels, hidden_width=6, samples_per_voxel=1.5, **chosen)
    return fill(field, seed)


def rendered(field, rays, gradients=False, chosen=None):
    """What the field's rays show, by the ways of training or of rendering."""
    with torch.set_grad_enabled(gradients):
        _, samples = sampled(field, rays)
        tau, lookup = field.optical_depths(rays, samples) if gradients else (samples.tau, None)
        made = composite_weights(tau, samples.starts, samples.skipped_before, samples.skipped_total)
        rgb, sums = field.render_colors(rays, samples, lookup, made, chosen)
        return SimpleNamespace(rgb=rgb, **vars(sums)), made


# By hand -------------------------------------------------------------------------------------------------------------


def shaded_by_hand(networks, mean, direction):
    """The colour of a ray that gathered ``mean`` on average: its odds times e^(what the network says)."""
    flat, layers, start = networks.weights.detach().double().numpy()[0], [], 0
    for shape in networks.shapes:
        layers.append(flat[start : start + math.prod(shape)].reshape(shape))
        start += math.prod(shape)
    waves = [direction * math.pi * 2**i for i in range(networks.frequencies[-1])]
    x = np.concatenate([mean, direction, *map(np.sin, waves), *map(np.cos, waves)])
    hidden = np.maximum(layers[0] @ x + layers[1], 0)
    hidden = np.maximum(layers[2] @ hidden + layers[3], 0)
    change = layers[4] @ hidden + layers[5]
    return 1 / (1 + np.exp(-(np.log(mean[:3] / (1 - mean[:3])) + 8 * np.tanh(change / 2))))


@pytest.fixture()
def raw_texels(monkeypatch):
    monkeypatch.setattr("random_fields._color", lambda networks, k, features, ndc, direction: features)


@pytest.mark.parametrize("gradients", [False, True])
@pytest.mark.parametrize(("num_mpis", "with_cube"), [(1, False), (3, True)])
def test_a_ray_shows_what_loops_in_float64_say(raw_texels, gradients, num_mpis, with_cube):
    field = ray_field(num_mpis, with_cube)
    origins, directions = random_rays(field.plan, 40, seed=3)
    colors, made = rendered(field, bundle(origins, directions), gradients)
    met = 0
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        ray = OracleRay(field, origin, direction)
        samples = sorted((s for head in ray.heads for s in head), key=lambda s: (-s.inverse_t, s.head, s.plane))
        if ray.margin < CLEAR or not samples:
            continue
        passed, gathered, mass, first, second = 1.0, np.zeros(7), 0.0, np.zeros(3), np.zeros(3)
        for s in samples:
            weight = passed * (1 - math.exp(-s.tau))
            passed *= math.exp(-s.tau)
            texel = np.concatenate([1 / (1 + np.exp(-s.color[:3])), np.tanh(s.color[3:])])
            gathered, mass = gathered + weight * texel, mass + weight
            first, second = first + weight * texel[:3], second + weight * texel[:3] ** 2
        wanted = (1 - passed) * shaded_by_hand(field.networks, gathered / mass, direction)
        assert np.abs(colors.rgb[i].detach().numpy() - wanted).max() < ERROR
        for actual, value in ((colors.mass, mass), (colors.first, first), (colors.second, second)):
            assert np.abs(actual[i].detach().numpy() - value).max() < ERROR
        met += 1
    assert met > 20 and made.accumulation.max() > 0.5


def test_rendering_shows_what_training_does():
    field = ray_field()
    rays = bundle(*random_rays(field.plan, 50, seed=4))
    a, b = rendered(field, rays)[0].rgb, rendered(field, rays, gradients=True)[0].rgb.detach()
    assert (a - b).abs().max() < 3e-6 and a.std() > 0.05


@pytest.mark.parametrize("path", ["auto", "torch"])
def test_gradients_of_texels_densities_and_network_are_those_of_float64(path):
    rays, upstream = bundle(*random_rays(random_plan(3, True, 0), 30, seed=5)), torch.linspace(-1, 1, 90).view(30, 3)
    actual = []
    for dtype in (torch.float32, F64):
        dispatch.choose(path)
        try:
            field = ray_field().to(dtype)
            if dtype == F64:
                rays = bundle(*random_rays(field.plan, 30, seed=5))
                for name in ("origins", "directions", "nears", "fars"):
                    setattr(rays, name, getattr(rays, name).double())
            colors, _ = rendered(field, rays, gradients=True)
            loss = (colors.rgb * upstream).sum() + (colors.first * upstream).sum() + (colors.second * upstream).sum()
            loss.backward()
        finally:
            dispatch.choose("auto")
        tables = (field.density, field.features, field.networks.weights)
        actual.append([p.grad.double() for p in tables])
    for a, b in zip(*actual, strict=True):
        assert b.abs().max() > 0.01 and (a - b).abs().max() < 1e-4 * b.abs().max()


@pytest.mark.parametrize("shading", ["ray", "sample"])
def test_rays_that_are_not_chosen_learn_no_colour(shading):
    field = ray_field() if shading == "ray" else random_field(3, with_cube=True)
    rays, chosen = bundle(*random_rays(field.plan, 20, seed=6)), torch.arange(20) % 2 == 0
    colors, _ = rendered(field, rays, gradients=True, chosen=chosen)
    everything, _ = rendered(field, rays, gradients=True)
    assert torch.allclose(colors.rgb[chosen], everything.rgb[chosen], rtol=0, atol=0 if shading == "ray" else 1e-6)
    assert not colors.first[~chosen].any()
    (colors.first[~chosen].sum() + colors.second[~chosen].sum()).backward()
    assert not field.features.grad.any()


def test_a_fresh_network_shows_the_diffuse_colour():
    field = ray_field()
    field.networks.resize(1)
    colors, made = rendered(field, bundle(*random_rays(field.plan, 20, seed=6)))
    diffuse = colors.first / colors.mass.clamp(min=1e-6) * made.accumulation
    assert torch.allclose(colors.rgb, diffuse, atol=1e-6) and len(field.networks.weights) == 1


# At the borders ------------------------------------------------------------------------------------------------------


def shade(weights, texels, network=0.3, channels=7):
    """One ray of samples with given colours and features: its colour, and the gradients of weights and texels."""
    shader = RayShader(1, channels, 8, 2)
    generator = torch.Generator().manual_seed(0)
    shader.weights.data = torch.randn(shader.weights.shape, generator=generator) * network
    weights, texels = (torch.tensor(x, dtype=torch.float32).requires_grad_() for x in (weights, texels))
    gathered = (weights[..., None] * texels).sum(1)
    accumulation = weights.sum(-1, keepdim=True)
    rgb = shader.shade(gathered, weights.sum(-1, keepdim=True), accumulation, torch.tensor([[0.6, 0.0, 0.8]]))
    rgb.sum().backward()
    return rgb.detach()[0], weights.grad, texels.grad


TEXEL = [0.2, 0.5, 0.9, 0.3, -0.8, 0.0, 1.0]


def test_a_ray_that_gathers_nothing_shows_nothing():
    rgb, to_weights, to_texels = shade([[0.0, 0.0]], [[TEXEL, TEXEL]])
    assert rgb.tolist() == [0, 0, 0] and not to_texels.any() and to_weights.isfinite().all()


def test_one_opaque_sample_shows_its_shaded_colour():
    rgb, _, _ = shade([[1.0]], [[TEXEL]], network=0.0)
    assert rgb.tolist() == pytest.approx(TEXEL[:3], abs=1e-6)


@pytest.mark.parametrize("weight", [1e-30, 1e-12, 1e-7, 1e-5, 1e-3])
def test_tiny_weights_show_in_proportion_with_finite_gradients(weight):
    rgb, to_weights, to_texels = shade([[weight, weight]], [[TEXEL, TEXEL]])
    full, _, _ = shade([[0.5, 0.5]], [[TEXEL, TEXEL]])
    assert rgb.isfinite().all() and (rgb >= 0).all() and (rgb <= 2 * weight * (1 + 1e-6)).all()
    if weight >= 1e-6:
        assert rgb.tolist() == pytest.approx((2 * weight * full).tolist(), rel=1e-4)
    assert to_weights.isfinite().all() and to_weights.abs().max() < 10 and to_texels.isfinite().all()


@pytest.mark.parametrize("color", [0.0, 1.0])
def test_saturated_colours_stay_colours_and_can_come_back(color):
    texel = [color] * 3 + TEXEL[3:]
    rgb, _, to_texels = shade([[1.0]], [[texel]], network=2.0)
    assert (rgb >= 0).all() and (rgb <= 1).all() and to_texels.isfinite().all()
    assert (to_texels[0, 0, :3].abs() > 1e-4).all()


@pytest.mark.parametrize("change", [-1e4, -30.0, 0.0, 30.0, 1e4, math.inf])
def test_colours_stay_between_0_and_1_whatever_the_network_says(change):
    color = torch.tensor([[0.0, 0.25, 1.0 + 1e-7]], requires_grad=True)
    changed = change_odds(color, torch.full((1, 3), change))
    assert (changed >= -1e-3).all() and (changed <= 1 + 1e-3).all()
    changed.sum().backward()
    assert color.grad.isfinite().all()


def test_changed_odds_and_their_gradients_are_those_of_the_formula():
    color = torch.tensor([[0.1, 0.5, 0.97]], dtype=F64, requires_grad=True)
    change = torch.tensor([[1.5, -2.0, 0.3]], dtype=F64, requires_grad=True)
    wanted = torch.sigmoid(torch.logit(color) + 8 * torch.tanh(change / 2))
    assert torch.allclose(change_odds(color, change), wanted, atol=1e-12)
    assert torch.autograd.gradcheck(change_odds, (color, change))
