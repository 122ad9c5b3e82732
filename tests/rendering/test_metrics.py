"""Pictures that are kept beside metrics."""

from __future__ import annotations

import torch

from mmpi_ns.rendering.metrics import pictures


def test_pictures_of_more_pixels_than_torch_sorts_are_made():
    side = 4097
    assert side**2 > 1 << 24
    row = torch.linspace(0.5, 2.0, side)
    one = torch.zeros(1, 1, 1)
    outputs = {
        "depth": (1 / row)[None, :, None].expand(side, side, 1), "rgb": one.expand(side, side, 3),
        "accumulation": one.expand(side, side, 1), "winning_mpi": one.long().expand(side, side, 1),
    }  # fmt: skip
    shown = pictures(one.expand(side, side, 3), outputs, 2)["inverse_depth"]
    brightest = torch.quantile(row, 0.98)
    assert torch.allclose(shown[1234, :, 0], (row / brightest).clamp(max=1), atol=1e-3)
