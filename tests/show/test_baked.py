"""Marching through baked bricks: the compiled form, and ours in NumPy, against the reader of files, on hard rays."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from random_bricks import random_window, rays_into, scene_of

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.march import Rays
from mmpi_ns.scene.bricks import columns_from
from mmpi_show import reader
from mmpi_show.files import write_baked
from mmpi_show.scene import SIDE, Shader

FORMS = ("reference", "cpu")


def marched(form, window, rays, peaks=None):
    if form == "cpu" and dispatch.form_of("render_baked", torch.zeros(1)) != "cpu":
        pytest.skip("no C++ compiler")
    return dispatch.function("render_baked", form)(window.mpis, Rays(*rays), window.threshold, peaks)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("settings", [
    {"num_mpis": 1}, {"num_mpis": 3, "planes": 70}, {"channels": 3}, {"channels": 16}, {"stored": 0.02},
    {"stored": 1.0}, {"density": (255, 255), "shares": (1e4, 1e4)}, {"density": (0, 0)},
    {"density": (90, 160), "planes": 90},
])  # fmt: skip
def test_agrees_with_the_reader(form, settings, tmp_path):
    """What a ray shows equals what a hundred lines of float64 NumPy make of the file."""
    window = random_window(seed=len(str(settings)), **settings)
    rays = rays_into(window)
    write_baked(scene_of(window), tmp_path)
    raw = reader.read(tmp_path)["windows"][0]
    assert len(raw["network_array"]) == sum(o * (i + 1) for o, i in raw["shader"]["layers"])
    expected = reader.render(raw, rays[0].double().numpy(), rays[1].double().numpy())
    actual = marched(form, window, rays)
    rendered = shaded(window, actual, rays[1]).numpy()
    # A ray that meets the border between stored and empty tiles to the last bit may read either.
    wrong = np.abs(rendered - expected).max(-1) > 5e-3
    assert wrong.mean() <= 0.05, np.abs(rendered - expected).max(-1)[wrong]
    if settings.get("stored") == 1.0:
        assert not wrong.any()
    if settings.get("density") != (0, 0):
        assert (actual.mass > 0).any()


def shaded(window, actual, directions):
    rgb = window.shader.shade(actual.gathered, actual.mass, directions)
    rgb = torch.where(actual.mass > 0, rgb, 0.0)
    return (rgb * actual.accumulation + 0.5 * actual.transmittance).clamp(0, 1)


@pytest.mark.parametrize("octaves", [0, 2, 5])
@pytest.mark.parametrize("sizes", [(7, 3), (64, 64, 3), (5, 9, 6, 3)])
def test_shading_agrees_with_the_reader(octaves, sizes):
    """Any widths and depths, black and white, and no mass at all."""
    g = torch.Generator().manual_seed(octaves)
    whole = (5 + 3 * (1 + 2 * octaves), *sizes)
    layers = tuple((torch.randn(o, i, generator=g), torch.randn(o, generator=g)) for i, o in pairwise(whole))
    shader = Shader(layers, octaves, 8.0)
    mass = torch.rand(101, 1, generator=g)
    sums = mass * (torch.rand(101, 5, generator=g) * torch.tensor([1, 1, 1, 2, 2]) - torch.tensor([0, 0, 0, 1, 1]))
    mass[3], sums[3], sums[4, :3], sums[5, :3] = 0, 0, 0, mass[5]
    directions = torch.nn.functional.normalize(torch.randn(101, 3, generator=g), dim=-1)
    actual = shader.shade(sums, mass, directions)
    network = {"direction_octaves": octaves, "layers": [w.shape for w, _ in layers], "bound": shader.bound}
    numbers = torch.cat([x.flatten() for layer in layers for x in layer]).numpy()
    mean = (sums / mass.clamp(min=1e-6)).double().numpy()
    expected = reader.shade({"shader": network, "network_array": numbers}, mean, directions.double().numpy())
    # White to the last bit is not white, and odds may change by e^8.
    np.testing.assert_allclose(actual.numpy(), expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("form", FORMS)
def test_rays_do_not_see_their_neighbours(form):
    """Rays are marched side by side: whatever their number and order, each finds what it finds alone, to the bit."""
    window = random_window(num_mpis=3, planes=70)
    rays = rays_into(window, 50)
    whole = marched(form, window, rays)
    parts = [marched(form, window, [x[a:b] for x in rays]) for a, b in ((0, 1), (1, 18), (18, 50))]
    turned = marched(form, window, [x.flip(0) for x in rays])
    for name, all_ in vars(whole).items():
        some, back = [getattr(part, name) for part in parts], getattr(turned, name)
        assert torch.equal(all_, torch.cat(some)) and torch.equal(all_, back.flip(0)), name


@pytest.mark.parametrize("form", FORMS)
def test_peaks_are_the_largest_weights(form):
    """A brick's peak is reached, a brick that no ray reads keeps 0, and one ray alone weighs no more than 1."""
    window = random_window(num_mpis=2, density=(150, 255))
    peaks = torch.zeros(window.mpis.num_bricks, 8, 8)
    actual = marched(form, window, rays_into(window, 16), peaks=peaks)
    assert float(peaks.max()) <= 1 and float(peaks.max()) >= float(actual.mass.max()) / 80
    assert (peaks == 0).any()
    kept = window.keep(peaks.amax((1, 2)) > 0)
    assert kept.mpis.num_bricks == int((peaks > 0).any(-1).any(-1).sum())
    again = marched(form, kept, rays_into(window, 16))
    torch.testing.assert_close(again.gathered, actual.gathered, rtol=1e-4, atol=1e-3)


def test_columns_find_every_brick():
    """Numbers and places of bricks survive the way through columns, beyond 32 planes and with the sign bit set."""
    window = random_window(num_mpis=1, planes=65, stored=0.7)
    (numbers,) = window.mpis.brick_numbers()
    assert sorted(numbers[numbers >= 0].tolist()) == list(range(window.mpis.num_bricks))
    columns, places = columns_from(numbers >= 0, 0)
    assert torch.equal(columns, window.mpis.columns) and len(columns) == window.mpis.first_column(1)
    assert torch.equal(numbers[tuple(places.T)], torch.arange(len(places), dtype=numbers.dtype))
    assert (window.mpis.columns[:, 0] < 0).any() and window.mpis.density.shape[1:] == (SIDE, SIDE)


@pytest.mark.parametrize("form", FORMS)
def test_no_rays_and_no_bricks(form):
    window = random_window(stored=0.0)
    actual = marched(form, window, rays_into(window, 20))
    assert (actual.mass == 0).all() and (actual.transmittance == 1).all() and (actual.inverse_t == 0).all()
    none = marched(form, random_window(), [x[:0] for x in rays_into(window, 20)])
    assert len(none.gathered) == 0
