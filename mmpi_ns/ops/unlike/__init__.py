"""By how much the colours of an image differ from those of others, if its points had given depths
(``capture/moving_evidence.py``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, Int64, UInt8
from torch import Tensor
from torch.nn import functional

from mmpi_ns.ops.dispatch import operation

ALL = 255
"""Difference from what shows nothing."""
CLEARLY, WINDOW = 80, 5
"""Levels beyond which a larger difference says no more, and side of the window over which differences are averaged."""
SAME, OCCLUDES = 12, 1.15
"""Levels by which colours of one surface differ at most, and the factor by which its inverse depths do."""
LEAST_AHEAD = 1e-6
"""Depth there over depth here, at least."""
APART = 2
"""Images that are compared with each other are at most so many apart in their order."""


class Layers(NamedTuple):
    """K images that an image is compared with."""

    colors: Int32[Tensor, "T"]
    """Blue, green, red, and whether that is shown (``ALL`` or 0, which it is at the border), in four bytes; one image
    after the other, row by row."""
    around: Float[Tensor, "T"]
    """Inverse depth of what is shown, or of something near; 0 where unknown."""
    extents: Int64[Tensor, "K 3"]
    """First pixel, height and width of each."""
    linear: Float[Tensor, "K 3 3"]
    """Homogeneous pixels of points are a + q b at inverse depth q (``ops/matches``); a at a pixel (x, y) of the image
    is this times (x, y, 1)."""
    b: Float[Tensor, "K 3"]

    @staticmethod
    def of(
        colors: Sequence[UInt8[Tensor, "h w 4"]],
        around: Sequence[Float[Tensor, "h w"]],
        parallax: Sequence[tuple[Tensor, Tensor]],
    ) -> Layers:
        """Images with their depths, and (linear, b) of each."""
        ends = torch.tensor([part.numel() for part in around]).cumsum(0)
        extents = [[int(end) - part.numel(), *part.shape] for end, part in zip(ends, around, strict=True)]
        linear, b = (torch.stack(parts) for parts in zip(*parallax, strict=True))
        packed = [part.contiguous().view(torch.int32).flatten() for part in colors]
        return Layers(
            torch.cat(packed), torch.cat([part.flatten() for part in around]), torch.tensor(extents), linear, b
        )


class Unlike(NamedTuple):
    """What other images say of an image whose points have given depths."""

    levels: UInt8[Tensor, "K H W"]
    """By which each differs from it; ``ALL`` where it shows nothing."""
    pair: UInt8[Tensor, "H W"]
    """By which it differs from both of two that agree and have nothing in front; 0 where none do."""
    agreed: Bool[Tensor, "H W"]
    """Where two do."""


@operation(in_cpp=0)
def compare_colors(color: Int32[Tensor, "H W"], inverse: Float[Tensor, "H W"], layers: Layers, pairs: bool) -> Unlike:
    """Compares the colours of an image with those of others.

    Args:
        color: blue, green and red of the image in the first three of four bytes.
        inverse: inverse depths.
        layers: the others.
        pairs: whether to look for two that agree.
    """
    height, width = color.shape
    here = _channels(color)
    x, y = torch.arange(width, dtype=inverse.dtype) + 0.5, torch.arange(height, dtype=inverse.dtype)[:, None] + 0.5
    levels, seen, free = [], [], []
    for (first, rows, columns), linear, b in zip(layers.extents.tolist(), layers.linear, layers.b, strict=True):
        right, down, ahead = (m[0] * x + (m[1] * y + m[2]) + inverse * s for m, s in zip(linear, b, strict=True))
        shown = ahead > LEAST_AHEAD
        divisor = torch.where(shown, ahead, 1.0)
        column, row = ((c / divisor - 0.5).clamp(0, n - 1).round().long() for c, n in ((right, columns), (down, rows)))
        at = first + torch.where(shown, row * columns + column, 0)  # the first pixel shows nothing
        there = _channels(layers.colors[at])
        shown = there[3] > 0
        high, low = functional.max_pool2d(there[:3], 3, 1, 1), -functional.max_pool2d(-there[:3], 3, 1, 1)
        apart = torch.maximum(low - here[:3], here[:3] - high).amax(0).clamp(0, CLEARLY)
        reach = WINDOW // 2
        apart = functional.avg_pool2d(_reflected(apart, reach)[None], WINDOW, 1)[0].round()
        levels.append(torch.where(shown, apart, ALL))
        if pairs:
            theirs = layers.around[at] * ahead
            free.append(shown & (theirs <= OCCLUDES * inverse) & (theirs * OCCLUDES >= inverse))
            seen.append(there[:3])
    pair, agreed = torch.zeros(height, width), torch.zeros(height, width, dtype=torch.bool)
    for a in range(len(seen)):
        for other in range(max(0, a - APART), a):
            agrees = free[a] & free[other] & ((seen[a] - seen[other]).abs().amax(0) < SAME)
            agreed |= agrees
            pair = torch.where(agrees, torch.maximum(pair, torch.minimum(levels[a], levels[other])), pair)
    return Unlike(torch.stack(levels).to(torch.uint8), pair.to(torch.uint8), agreed)


def _channels(packed: Tensor) -> Tensor:
    """The four bytes of each pixel. [4, H, W]"""
    return packed.contiguous().view(torch.uint8).view(*packed.shape, 4).movedim(-1, 0).float()


def _reflected(image: Tensor, reach: int) -> Tensor:
    """An image with its pixels next to the border beyond it, mirrored about those at the border."""
    rows, columns = (_mirrored(n, reach) for n in image.shape)
    return image[rows[:, None], columns]


def _mirrored(size: int, reach: int) -> Tensor:
    at, last = torch.arange(-reach, size + reach).abs(), size - 1
    return (last - (last - at).abs()).abs().clamp(max=last)
