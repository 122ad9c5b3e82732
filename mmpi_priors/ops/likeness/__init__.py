"""Plane sweep: correlation of an image's windows with other images at inverse depths common to all pixels.

Positions in the others are rounded to a 32nd of a pixel and gray levels to integers, as OpenCV does, so that sums over
windows are exact in any order and can slide from pixel to pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mmpi_ns.ops.dispatch import operation
from mmpi_priors.ops.patches import Others

REACH, PIXELS, STEPS = 3, 49, 32
"""Pixels of a window on each side of its centre, all of them, and subpixel positions. Windows whose gray levels have a
standard deviation below 1 count as 1."""


class Likeness(NamedTuple):
    """Best inverse depths of three kinds at each pixel: possible ones, impossible ones, and those at which another
    image has a marked pixel."""

    alike: Float[Tensor, "3 H W"]
    """The largest correlation, -1 where there is none."""
    inverse: Float[Tensor, "3 H W"]
    """The first inverse depth with it, 0 where there is none."""


@operation(in_cpp=0)
def most_alike(
    gray: UInt8[Tensor, "H W"],
    others: Others,
    inverse: Float[Tensor, "D"],
    least: Float[Tensor, "H W"],
    most: float,
    pairs: bool,
) -> Likeness:
    """Inverse depths with the largest correlation between an image and others.

    Args:
        gray: the image.
        others: the others, each at its size and as marks, in a border of 0 that is a pixel wide; 0 is nothing.
        inverse: inverse depths, behind the camera below 0.
        least: the smallest possible one of each pixel.
        most: the largest possible one of all.
        pairs: use the mean of the best two others, whatever is marked, instead of each alone.
    """
    shape, none = (3, *gray.shape), torch.full(gray.shape, -1.0)
    alike, at, image = torch.full(shape, -1.0), torch.zeros(shape), gray.int()
    contrast = _sums(image), _over_contrast(image)
    for q in inverse:
        seen = [_compare(image, *contrast, others, k, q) for k in range(len(others.b))]
        if pairs:
            seen = [(torch.stack([none, *(one for one, _ in seen)]).topk(2, 0).values.mean(0), none > 0)]
        for one, is_marked in seen:
            kind = torch.where(is_marked, 2, torch.where((q >= least) & (q <= most), 0, 1))
            better = (one > alike) & (kind == torch.arange(3)[:, None, None])
            alike, at = torch.where(better, one, alike), torch.where(better, q, at)
    return Likeness(alike, at)


def _compare(image: Tensor, sums: Tensor, over: Tensor, others: Others, k: int, q: Tensor) -> tuple[Tensor, Tensor]:
    """Correlations with another image, and where it is marked. [H, W] each"""
    (first, height, width), (first_mark, *_) = others.levels[k].tolist()
    a, (y, x) = others.linear[k], (torch.arange(n) + 0.5 for n in image.shape)
    place = a[:, :1, None] * x + ((a[:, 1:2] * y + a[:, 2:]) + q * others.b[k][:, None])[..., None]
    ahead = place[2] > 0
    places = (c / torch.where(ahead, place[2], 1.0) + 0.5 for c in place[:2])
    column, row = (c.nan_to_num(0).clamp(0, n - 1) for c, n in zip(places, (width, height), strict=True))
    right, down = ((STEPS * c).round().int() for c in (column, row))
    table, u, v = others.corners.view(torch.uint8).view(-1, 4), right % STEPS, down % STEPS
    four = table[first + down // STEPS * width + right // STEPS].int().unbind(-1)
    upper, lower = ((STEPS - u) * four[n] + u * four[n + 1] for n in (0, 2))
    seen = torch.where(ahead, ((STEPS - v) * upper + v * lower + STEPS**2 // 2) // STEPS**2, 0)
    product = PIXELS * _sums(image * seen) - sums * _sums(seen)
    is_marked = ahead & (table[first_mark + (row + 0.5).int() * width + (column + 0.5).int(), 0] > 0)
    return torch.where(seen > 0, product * over * _over_contrast(seen), -1.0), is_marked


def _over_contrast(image: Tensor) -> Tensor:
    """1 over the standard deviation and the number of pixels of the window about each pixel."""
    return (PIXELS * _sums(image.square()) - _sums(image).square()).clamp(min=PIXELS**2).float().rsqrt()


def _sums(image: Tensor) -> Tensor:
    """Over the window about each pixel; beyond the border are the pixels of the border."""
    rows, columns = (torch.arange(-REACH, n + REACH).clamp(0, n - 1) for n in image.shape)
    totals = torch.nn.functional.pad(image[rows[:, None], columns].cumsum(0).cumsum(1), (1, 0, 1, 0))
    down = totals[2 * REACH + 1 :] - totals[: -2 * REACH - 1]
    return down[:, 2 * REACH + 1 :] - down[:, : -2 * REACH - 1]
