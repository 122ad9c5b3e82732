"""Codes that no training view would miss: what they may be off by, and that nothing is stored of them."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from random_bricks import random_window

from mmpi_show.codes import smoothed_codes
from mmpi_show.reader import take_borders
from mmpi_show.scene import CELLS, most_of_copies


def rough_window():
    """Codes that vary slowly through bricks, with noise, and slack of every size, 0 and 255 among it."""
    window, g = random_window(seed=3, stored=0.7), torch.Generator().manual_seed(0)
    mpis, waves = window.mpis, torch.linspace(0, 3, 8).sin()
    smooth = 120 + 90 * (waves[:, None] * torch.randn(mpis.num_bricks, 1, 8, generator=g)).tanh()
    noise = torch.randint(-9, 10, mpis.texels.shape, generator=g) * (torch.rand(mpis.texels.shape, generator=g) < 0.3)
    codes = (smooth[..., None] + noise).clamp(0, 255).to(torch.uint8)
    beside = mpis.neighbours()
    take_borders(codes.numpy(), beside)
    slack = (12 * torch.randn(codes.shape[:3], generator=g)).clamp(0, 255).to(torch.uint8)
    slack[::7], slack[::5] = 0, 255
    return replace(window, mpis=replace(mpis, texels=codes)), slack, beside


def expected_code(codes, y, x):
    """What the format expects of a texel from those of its brick that are read before it."""
    at = lambda v, u: int(codes[v, u]) if v >= 0 and u >= 0 else 0  # noqa: E731
    if y % 2 == 0 and x % 2 == 0:
        return at(y, x - 2) + at(y - 2, x) - at(y - 2, x - 2)
    before, after = ((y, x - 1), (y, x + 1)) if y % 2 == 0 else ((y - 1, x), (y + 1, x))
    return (at(*before) + at(*(after if max(after) < 8 else before))) // 2


def test_a_code_is_exact_or_expected_and_within_its_slack():
    window, slack, beside = rough_window()
    codes = window.mpis.texels[..., 0].contiguous()
    smooth = smoothed_codes(codes, slack, beside)
    settled = 0
    for brick, (right, below) in enumerate(beside.T.tolist()):
        for y, x in itertools.product(range(8 - (below >= 0)), range(8 - (right >= 0))):
            exact, code, allowed = (int(each[brick, y, x]) for each in (codes, smooth, slack))
            expected = expected_code(smooth[brick], y, x)
            off = abs(expected - exact) <= allowed and (y, x) != (0, 0)
            assert code == (min(max(expected, 0), 255) if off else exact), (brick, y, x)
            assert abs(code - exact) <= allowed
            settled += off
    again = smooth.clone()
    take_borders(again.numpy(), beside)
    assert torch.equal(again, smooth)
    assert 0.3 < settled / codes.numel() < 0.7
    assert torch.equal(smoothed_codes(codes, torch.zeros_like(slack), beside), codes)


@pytest.mark.parametrize("stored", [0.3, 0.7, 1.0])
def test_copies_of_a_texel_have_the_largest_value_of_them(stored):
    """By the place of each texel in its plane; bricks that touch at a corner alone keep a value each."""
    window = random_window(seed=1, stored=stored)
    mpis, values = window.mpis, torch.rand(window.mpis.density.shape, generator=torch.Generator().manual_seed(2))
    beside = mpis.neighbours()
    most = most_of_copies(values, beside)
    for numbers in mpis.brick_numbers():
        copies: dict[tuple[int, ...], list[tuple[int, int, int]]] = {}
        for (plane, row, column), number in np.ndenumerate(numbers.numpy()):
            for y, x in itertools.product(range(8), range(8)) if number >= 0 else ():
                copies.setdefault((plane, CELLS * row + y, CELLS * column + x), []).append((int(number), y, x))
        for texels in copies.values():
            largest = max(float(values[texel]) for texel in texels)
            assert all(float(values[texel]) <= float(most[texel]) <= largest for texel in texels)
            assert stored < 1 or all(float(most[texel]) == largest for texel in texels)
    agreeing = most.clone()
    take_borders(agreeing.numpy(), beside)
    assert torch.equal(agreeing, most)
