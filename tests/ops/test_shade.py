"""The compiled colours of samples against the colour networks in float64."""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import Any

import pytest
import torch
from compiled import compiled, normal  # noqa: F401
from random_fields import bundle, random_field, random_rays, sampled

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops import dispatch


def shaded(channels=9, width=32, octaves=(2, 2)):
    """A field of four MPIs and a cube, samples in all of them, and their colours by the networks in float64."""
    plan = random_field(4, True, seed=7).plan
    sizes: dict[str, Any] = {"feature_channels": channels, "hidden_width": width}
    sizes |= {"position_frequencies": octaves[0], "direction_frequencies": octaves[1]}
    field = MMPIField(plan, **sizes).eval()
    field.features.data = normal(*field.features.shape, seed=1) * 2
    field.networks.weights.data = normal(*field.networks.weights.shape, seed=2) * 0.3
    rays, samples = sampled(field, bundle(*random_rays(plan, 60, seed=8)))
    assert samples.heads.unique().numel() == 5
    return field, (rays, samples)


def colors(field, samples):
    with torch.no_grad():
        return field.sample_colors(*samples)


def in_float64(field, samples):
    """By the lookup and the networks of training."""
    field._packed = {}  # made anew in float64
    exact, (rays, merged) = copy.deepcopy(field).double(), copy.deepcopy(samples)
    rays.directions = rays.directions.double()
    return exact.sample_colors(rays, dataclasses.replace(merged, ndc=merged.ndc.double())).detach()


@pytest.mark.parametrize(("channels", "width", "octaves"), [(3, 5, (0, 0)), (9, 32, (2, 2)), (17, 64, (4, 1))])
def test_colours_are_those_of_the_networks(channels, width, octaves):
    field, samples = shaded(channels, width, octaves)
    wanted, valid = in_float64(field, samples), samples[1].valid
    assert dispatch.form_of("shade", field.features.data, samples[1].ndc) == "cpu"
    assert wanted[valid].std() > 0.05
    for route in ("native", "torch"):
        with dispatch.chosen(route):
            found = colors(field, samples)
        assert (found.double() - wanted).abs().max() < 2e-5 and (found[~valid] == 0).all()


def test_colours_say_where_a_feature_is_not_a_number():
    field, samples = shaded()
    before = colors(field, samples).isnan().any(-1)
    read = field._lookup(*samples)
    field.features.data[read.rows[read.taps[0].positions[3, 0]], 5] = math.nan
    found = colors(field, samples).isnan().any(-1)
    assert not before.any() and found.reshape(-1)[read.index[3]] and not found.all()
