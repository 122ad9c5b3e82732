"""Whole rays through hard tables: samples, colours and the gradient of every table against plain torch in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from random_scenes import CUBE, gradients_of, random_scene, samples_of

HARD = {
    "K = 1": (1, False, None),
    "4 MPIs, joint": (4, False, None),
    "4 MPIs and a cube": (4, True, CUBE),
    "12 MPIs": (12, True, None),
    "raw densities +-1e4": (3, True, None),
    "reliabilities +-100": (3, True, None),
    "optical depths below 1e-4": (3, True, None),
    "60 % of the texels untrained": (4, True, None),
}


@pytest.mark.parametrize("hard", HARD)
def test_whole_rays_and_their_gradients_are_those_of_float64(hard):
    count, blends, cube = HARD[hard]
    s = random_scene(count, 200 if hard.startswith("reliabilities") else 24, blends, seed=count, cube=cube)
    field, g = s.field, torch.Generator().manual_seed(count)
    if hard.startswith("raw"):
        field.density.data.copy_(1e4 * torch.randn(field.density.shape, generator=g).sign())
    elif hard.startswith("reliabilities"):
        field.reliability.data.normal_(generator=g).mul_(100)
    elif hard.startswith("optical"):
        field.density.data.uniform_(-30, -8, generator=g)
    elif hard.startswith("60"):
        field.touched.copy_(torch.rand(field.touched.shape, generator=g) > 0.6)
    s = s.clear()
    exact, by = s.exact(), np.random.default_rng(0).normal(size=(len(s.bundle), 3))
    actual, wanted = s.render(), exact.render()
    assert samples_of(actual)[0] == samples_of(wanted)[0]
    assert float((actual.rgb - wanted.rgb).abs().max()) <= 2e-4 * float(wanted.rgb.abs().max())
    slopes, exactly = gradients_of(field, actual, by), gradients_of(exact.field, wanted, by)
    assert slopes.keys() == exactly.keys() >= {"density", "features"} and blends == ("reliability" in slopes)
    for name, slope in slopes.items():
        assert torch.isfinite(slope).all()
        assert float((slope - exactly[name]).abs().max()) <= 1e-3 * float(exactly[name].abs().max()) + 1e-30, name
