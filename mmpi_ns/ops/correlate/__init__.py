"""How alike two images are around each pixel, if what they show had a given depth (``capture/moving_sweep.py``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32, Int64, UInt8
from torch import Tensor
from torch.nn import functional

from mmpi_ns.ops.dispatch import operation

WINDOW, LEAST_CONTRAST = 7, 1.0
"""Pixels along the side of the windows that are compared, and the standard deviation of gray levels that a window
counts as having at least."""
LEAST_AHEAD = 1e-6
"""Depth there over depth here, at least."""
STEPS = 32
"""Parts of a pixel between which gray levels are interpolated, as by OpenCV."""


class Compared(NamedTuple):
    """K images that an image is compared with."""

    corners: Int32[Tensor, "T"]
    """Of one after the other, row by row, each 2 x 2 pixels in four bytes, from two pixels beyond the borders on, where
    gray levels are 0: nothing is shown."""
    extents: Int64[Tensor, "K 3"]
    """First corner, and rows and columns of corners, of each."""
    linear: Float[Tensor, "K 3 3"]
    """Homogeneous pixels of points are a + q b at inverse depth q (``ops/matches``); a at a pixel (x, y) of the image
    is this times (x, y, 1)."""
    b: Float[Tensor, "K 3"]

    @staticmethod
    def of(grays: Sequence[UInt8[Tensor, "h w"]], parallax: Sequence[tuple[Tensor, Tensor]]) -> Compared:
        """Images, at gray level 0 where they show nothing, with (linear, b) of each."""
        corners, sizes, first = [], [], 0
        for gray in grays:
            padded, (rows, columns) = functional.pad(gray, (2, 2, 2, 2)), (n + 3 for n in gray.shape)
            parts = [padded[y : y + rows, x : x + columns] for y, x in ((0, 0), (0, 1), (1, 0), (1, 1))]
            corners.append(torch.stack(parts, -1).view(torch.int32).flatten())
            sizes.append([first, rows, columns])
            first += rows * columns
        linear, b = (torch.stack(parts) for parts in zip(*parallax, strict=True))
        return Compared(torch.cat(corners), torch.tensor(sizes), linear, b)


@operation(in_cpp=0)
def correlate_at(
    gray: UInt8[Tensor, "H W"],
    mean: Float[Tensor, "H W"],
    contrast: Float[Tensor, "H W"],
    others: Compared,
    inverse: float,
) -> Float[Tensor, "K H W"]:
    """Normalised correlation of windows about the pixels of an image and of others at an inverse depth; -1 where they
    show nothing.

    Args:
        gray: the image.
        mean, contrast: mean and standard deviation of gray levels in its windows.
        others: the others.
        inverse: of the depth that all points are taken to have.
    """
    height, width = gray.shape
    x, y = torch.arange(width, dtype=mean.dtype) + 0.5, torch.arange(height, dtype=mean.dtype)[:, None] + 0.5
    result = []
    for (first, rows, columns), linear, b in zip(others.extents.tolist(), others.linear, others.b, strict=True):
        right, down, ahead = (m[0] * x + (m[1] * y + m[2] + inverse * s) for m, s in zip(linear, b, strict=True))
        divisor = torch.where(ahead > LEAST_AHEAD, ahead, 1.0)
        column, row = (((c / divisor - 0.5) * STEPS).clamp(-1e5, 1e5).round().long() for c in (right, down))
        left, top = ((c // STEPS + 2).clamp(0, n - 1) for c, n in ((column, columns), (row, rows)))
        four = others.corners[first + torch.where(ahead > LEAST_AHEAD, top * columns + left, 0)]
        four, u, v = four.view(torch.uint8).view(height, width, 4).long(), column % STEPS, row % STEPS
        upper, lower = (four[..., n] * (STEPS - u) + four[..., n + 1] * u for n in (0, 2))
        seen = (upper * (STEPS - v) + lower * v + STEPS**2 // 2) // STEPS**2
        theirs = seen.to(mean.dtype)
        their_mean, square, product = (_mean(part) for part in (theirs, theirs * theirs, theirs * gray.to(mean.dtype)))
        contrasts = contrast, (square - their_mean * their_mean).clamp(min=0).sqrt()
        alike = (product - mean * their_mean) / torch.stack(contrasts).clamp(min=LEAST_CONTRAST).prod(0)
        result.append(torch.where(seen > 0, alike, -1.0))
    return torch.stack(result)


def _mean(image: Tensor) -> Tensor:
    """In a window about each pixel, beyond the borders of pixels like those at the border."""
    reach = WINDOW // 2
    padded = functional.pad(image[None, None], (reach, reach, reach, reach), mode="replicate")
    return functional.avg_pool2d(padded, WINDOW, 1)[0, 0]
