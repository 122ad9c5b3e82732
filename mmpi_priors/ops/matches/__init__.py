"""Parallax between two images: where points appear in the other one, depths of matches there, and their mean.

A point at inverse depth q on pixel (x, y) of an image appears in another one at the homogeneous pixel a + q b, where a
is linear in (x, y, 1) (``mmpi_priors/dense.py``). A match there gives two linear equations r + q s = 0.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mmpi_ns.ops.dispatch import operation
from mmpi_priors.ops.motion import between

FAR = -1e4
"""Pixel of a point behind the other image."""
LEAST_AHEAD = 1e-6
"""Depth over that in the first image, below which a point is behind the other one."""
AGREE = 2.5
"""Measurements agree if they differ by at most this many standard deviations."""


class Places(NamedTuple):
    """Positions of an image's pixels in another image."""

    x: Float[Tensor, "H W"]
    """Pixels, ``FAR`` for points behind."""
    y: Float[Tensor, "H W"]
    ahead: Float[Tensor, "H W"]
    """Depth there over depth here; 0 for points behind."""


class Moved(NamedTuple):
    """Values of two maps at the ends of motions."""

    x: Float[Tensor, "H W"]
    y: Float[Tensor, "H W"]


class Compared(NamedTuple):
    """Comparison of an image's depths with another's."""

    confirms: Bool[Tensor, "H W"]
    """The other has the same depth there,"""
    contradicts: Bool[Tensor, "H W"]
    """or a farther one: it sees through the point."""


class Measured(NamedTuple):
    """Inverse depths with their certainty or error; both 0 where there is none."""

    inverse: Float[Tensor, "H W"]
    certainty: Float[Tensor, "H W"]
    """One over the squared error of a match; the error of a mean."""


@operation(in_cpp=0)
def place_pixels(inverse: Float[Tensor, "H W"], linear: Float[Tensor, "3 3"], b: Float[Tensor, "3"]) -> Places:
    """Positions of pixels in another image.

    Args:
        inverse: inverse depths of an image.
        linear: a at a pixel (x, y) is this times (x, y, 1).
        b: change of the homogeneous pixel for each unit of inverse depth.
    """
    x, y, ahead = (a + inverse * shift for a, shift in zip(linear_at(inverse, linear), b, strict=True))
    behind = ~(ahead > LEAST_AHEAD)
    divisor = torch.where(behind, 1.0, ahead)
    x, y = (torch.where(behind, FAR, c / divisor) for c in (x, y))
    return Places(x, y, torch.where(behind, 0.0, ahead))


@operation(in_cpp=0)
def follow_motion(x: Float[Tensor, "H W"], y: Float[Tensor, "H W"], motion: Float[Tensor, "H W 2"]) -> Moved:
    """Values of two maps at the ends of motions, interpolated; beyond the borders those of the border.

    Args:
        x, y: the maps.
        motion: right and down, pixels.
    """
    right, down = torch.arange(x.shape[1]), torch.arange(len(motion))[:, None]
    return Moved(*between(torch.stack([x, y], -1), right + motion[..., 0], down + motion[..., 1]).unbind(-1))


@operation(in_cpp=0)
def solve_matches(
    x: Float[Tensor, "H W"],
    y: Float[Tensor, "H W"],
    alike: Float[Tensor, "H W"],
    usable: Bool[Tensor, "H W"],
    linear: Float[Tensor, "3 3"],
    b: Float[Tensor, "3"],
    variance: float,
    farthest_squared: float,
) -> Measured:
    """Inverse depths of matches, by least squares: q = -r.s / s.s.

    Args:
        x, y: pixels of another image that match those of the image.
        alike: correlation of the windows about both.
        usable: which matches count.
        linear, b: as of ``place_pixels``.
        variance: of a match where images look alike, square pixels.
        farthest_squared: square of the largest distance from the epipolar line, square pixels.
    """
    a = linear_at(x, linear)
    r1, s1 = a[0] - x * a[2], b[0] - x * b[2]
    r2, s2 = a[1] - y * a[2], b[1] - y * b[2]
    squared = (s1 * s1 + s2 * s2).clamp(min=1e-20)
    inverse = -(r1 * s1 + r2 * s2) / squared
    depth = a[2] + inverse * b[2]
    across = r1 * s2 - r2 * s1  # of r and s, as r + q s is what of r is not along s
    off_line = across * across / (squared * depth * depth)
    certainty = squared / (depth * depth * (variance + off_line) * (11 - 10 * alike.clamp(max=1)))
    kept = usable & (depth > LEAST_AHEAD) & (off_line < farthest_squared) & inverse.isfinite() & certainty.isfinite()
    return Measured(torch.where(kept, inverse, 0.0), torch.where(kept, certainty, 0.0))


@operation(in_cpp=0)
def average_matches(
    inverse: Float[Tensor, "M H W"], certainty: Float[Tensor, "M H W"], most_relative: float
) -> Measured:
    """The mean of the largest consistent subset of the M measurements of each pixel, and its error.

    The error is at least the scatter of the subset. A single measurement counts if there is no other.

    Args:
        inverse: measurements.
        certainty: one over their squared errors; 0 without a measurement.
        most_relative: means with a larger relative error are discarded.
    """
    there = certainty > 0
    variance, fewest = AGREE**2 / certainty.clamp(min=1e-30), there.sum(0).clamp(max=2)
    all_certainty = certainty.sum(0).clamp(min=1e-30)
    best, mean, error = (torch.zeros_like(inverse[0]) for _ in range(3))
    for k in range(len(inverse)):
        apart = inverse - inverse[k]  # relative to measurement k, so that sums of squares are exact
        agrees = there & there[k] & (apart * apart < variance + variance[k])
        weight = torch.where(agrees, certainty, 0.0)
        number, total = agrees.sum(0), weight.sum(0).clamp(min=1e-30)
        first = (weight * apart).sum(0)
        shift = first / total
        scatter = ((weight * apart * apart).sum(0) - first * shift).clamp(min=0) / (number - 1).clamp(min=1)
        value, average = number + total / all_certainty, inverse[k] + shift
        better = there[k] & (number >= fewest) & (average > 0) & (value > best)
        best, mean = torch.where(better, value, best), torch.where(better, average, mean)
        error = torch.where(better, (scatter.clamp(min=1) / total).sqrt(), error)
    kept = (best > 0) & (error < most_relative * mean)
    return Measured(torch.where(kept, mean, 0.0), torch.where(kept, error, 0.0))


@operation(in_cpp=0)
def compare_depths(
    inverse: Float[Tensor, "H W"],
    error: Float[Tensor, "H W"],
    their_inverse: Float[Tensor, "A B"],
    their_error: Float[Tensor, "A B"],
    linear: Float[Tensor, "3 3"],
    b: Float[Tensor, "3"],
    same: float,
) -> Compared:
    """Whether another image confirms or contradicts depths, by its nearest pixel where both have one.

    Args:
        inverse: inverse depths of an image; 0 without one.
        error: their expected errors.
        their_inverse, their_error: the same of the other image.
        linear, b: as of ``place_pixels``.
        same: relative difference, beside three errors, within which depths agree.
    """
    height, width = their_inverse.shape
    x, y, ahead = place_pixels.reference(inverse, linear, b)
    column, row = (x - 0.5).round(), (y - 0.5).round()
    both = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (inverse > 0)
    place = torch.where(both, row, 0.0).long() * width + torch.where(both, column, 0.0).long()
    theirs, their_errors = their_inverse.flatten()[place], their_error.flatten()[place]
    expected = inverse / ahead.clamp(min=LEAST_AHEAD)
    tolerance, apart = 3 * torch.hypot(their_errors, error) + same * expected, theirs - expected
    both &= theirs > 0
    return Compared(both & (apart.abs() < tolerance), both & (apart < -tolerance))


def linear_at(image: Tensor, linear: Tensor) -> list[Tensor]:
    """The three parts of a at the pixels of an image. [H, W] each"""
    x = torch.arange(image.shape[1], dtype=image.dtype) + 0.5
    y = torch.arange(image.shape[0], dtype=image.dtype)[:, None] + 0.5
    return [m[0] * x + (m[1] * y + m[2]) for m in linear]
