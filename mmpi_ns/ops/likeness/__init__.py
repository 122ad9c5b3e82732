"""How alike an image and others are at inverse depths that are the same all over it, by correlation of windows.

A pixel at inverse depth q appears in another image at the homogeneous pixel a + q b (``ops/matches``). Places there are
rounded to a 32nd of a pixel and gray levels to integers, as OpenCV does, so that sums over windows are exact in any
order and can slide from pixel to pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from mmpi_ns.ops.dispatch import operation

REACH, PIXELS = 3, 49
"""Pixels of a window on each side of its middle, and all of them. A window with a smaller standard deviation of its
gray levels than 1 counts as one of 1."""
STEPS = 32
"""Places in a pixel that are told apart."""


class Others(NamedTuple):
    """K images that an image is compared with."""

    gray: UInt8[Tensor, "P"]
    """Gray levels of all of them, row by row, one after the other; 0: nothing, as is beyond the border."""
    marked: UInt8[Tensor, "P"]
    """1 for marked pixels, else 0."""
    sizes: Int64[Tensor, "K 2"]
    """Height and width of each."""
    linear: Float[Tensor, "K 3 3"]
    """a at a pixel (x, y) of the image is this times (x, y, 1)."""
    b: Float[Tensor, "K 3"]


class Likeness(NamedTuple):
    """Of the inverse depths of three kinds, at each pixel: those that are possible, the others, and those at which
    another image shows a marked pixel."""

    alike: Float[Tensor, "3 H W"]
    """The largest correlation, -1 where there is none."""
    inverse: Float[Tensor, "3 H W"]
    """The first inverse depth that has it, 0 where there is none."""


@operation(in_cpp=0)
def most_alike(
    gray: UInt8[Tensor, "H W"],
    others: Others,
    inverse: Float[Tensor, "D"],
    least: Float[Tensor, "H W"],
    most: float,
    pairs: bool,
) -> Likeness:
    """Inverse depths at which an image and others are most alike.

    Args:
        gray: the image.
        others: the others.
        inverse: inverse depths, behind the camera below 0.
        least: the smallest possible one of each pixel.
        most: the largest possible one of all.
        pairs: the mean of the best two others counts, whatever is marked, instead of each alone.
    """
    shape, windows = (3, *gray.shape), _Windows(gray)
    alike, at = torch.full(shape, -1.0), torch.zeros(shape)
    images = [
        part.view(2, *size)
        for part, size in zip(
            torch.stack([others.gray, others.marked]).split(others.sizes.prod(1).tolist(), 1),
            others.sizes.tolist(),
            strict=True,
        )
    ]
    for q in inverse:
        seen = [windows.compare(*each, q) for each in zip(images, others.linear, others.b, strict=True)]
        if pairs:
            none = torch.full(gray.shape, -1.0)
            best = torch.stack([none, none, *(one for one, _ in seen)]).topk(2, 0).values.mean(0)
            seen = [(best, torch.zeros(gray.shape, dtype=torch.bool))]
        for one, is_marked in seen:
            kind = torch.where(is_marked, 2, torch.where((q >= least) & (q <= most), 0, 1))
            better = (one > alike) & (kind == torch.arange(3)[:, None, None])
            alike, at = torch.where(better, one, alike), torch.where(better, q, at)
    return Likeness(alike, at)


class _Windows:
    """Windows about the pixels of an image."""

    def __init__(self, gray: Tensor) -> None:
        self.gray = gray.long()
        self.sums, self.squares = _sums(self.gray), _sums(self.gray.square())

    def compare(self, image: Tensor, linear: Tensor, b: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Correlations with another image, and where it is marked. [H, W] each"""
        (height, width), padded = image.shape[1:], torch.nn.functional.pad(image.long(), (1, 2, 1, 2))
        y, x = (torch.arange(n) + 0.5 for n in self.gray.shape)
        at = linear[:, :1, None] * x + ((linear[:, 1:2] * y + linear[:, 2:]) + q * b[:, None])[..., None]
        ahead = at[2] > 0
        over = 1 / torch.where(ahead, at[2], 1.0)
        column, row = ((c * over - 0.5).nan_to_num(-1).clamp(-1, n) for c, n in ((at[0], width), (at[1], height)))
        to_right, to_down = ((STEPS * c).round().long() for c in (column, row))
        left, top, u, v = to_right // STEPS + 1, to_down // STEPS + 1, to_right % STEPS, to_down % STEPS
        upper, lower = ((STEPS - u) * padded[0, rows, left] + u * padded[0, rows, left + 1] for rows in (top, top + 1))
        seen = torch.where(ahead, ((STEPS - v) * upper + v * lower + STEPS**2 // 2) // STEPS**2, 0)
        sums, squares = _sums(seen), _sums(seen.square())
        product = PIXELS * _sums(self.gray * seen) - self.sums * sums
        mine, theirs = (
            (PIXELS * second - first * first).clamp(min=PIXELS**2).float().rsqrt()
            for first, second in ((self.sums, self.squares), (sums, squares))
        )
        is_marked = ahead & (padded[1, (row + 1.5).long(), (column + 1.5).long()] > 0)
        return torch.where(seen > 0, product * mine * theirs, -1.0), is_marked


def _sums(values: Tensor) -> Tensor:
    """Over the window about each pixel; beyond the border are those of the border."""
    rows, columns = (torch.arange(-REACH, n + REACH).clamp(0, n - 1) for n in values.shape)
    side = 2 * REACH + 1
    return values[rows].unfold(0, side, 1).sum(-1)[:, columns].unfold(1, side, 1).sum(-1)
