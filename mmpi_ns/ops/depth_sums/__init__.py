"""Sums over a ray's samples for the depth losses: the spread of its weights, and their mass near a depth prior."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

REACH = 3.0
"""Widths within which a sample reaches the target of its ray."""


class DepthSums(NamedTuple):
    """Sums over the samples of each ray."""

    spread: Float[Tensor, "R"]
    """sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 delta, with s = 1 / (1 + scale / t)."""
    mass: Float[Tensor, "R"]
    """sum_i w_i exp(-1/2 ((1/t_i - target) / width)^2)."""
    reached: Bool[Tensor, "R"]
    """Whether the ray has a target and a sample within three widths of it."""


def depth_sums(
    weights: Float[Tensor, "R S"],
    inverse_t: Float[Tensor, "R S"],
    valid: Bool[Tensor, "R S"],
    intervals: Float[Tensor, "R"],
    targets: Float[Tensor, "R 2"],
    scale: float,
) -> DepthSums:
    """Spread and mass of each ray, with gradients to the weights of its samples.

    Args:
        weights: rendering weights, 0 in empty slots.
        inverse_t: inverse distances of the samples, front to back.
        valid: which slots hold a sample.
        intervals: delta, the length of a ray's samples on the map s.
        targets: inverse distance of the depth prior, 0 for none, and the width of the window around it (> 0).
        scale: distance that s maps to 1/2.

    Source: spread: mip-NeRF 360 eq. (15), in O(S) a ray by prefix sums as in DVGO v2.
    """
    with torch.no_grad():  # in place: memory takes most of the time
        positions = (scale * inverse_t).add_(1).reciprocal_()
        passed, moments = weights.cumsum(-1), (weights * positions).cumsum(-1)
        slope = (2 * passed).sub_(passed[:, -1:]).mul_(positions).add_(moments[:, -1:]).sub_(moments, alpha=2)
        slope.mul_(2).addcmul_(weights, intervals[:, None], value=2 / 3)
        away = (inverse_t - targets[:, :1]).div_(targets[:, 1:]).square_()
        nearest = torch.where(valid, away, torch.inf).amin(-1)
        # Bounded from below, since exponentials that underflow take far longer.
        window = away.clamp_(max=120).mul_(-0.5).exp_()
    twice = (weights * slope).sum(-1)  # a quadratic form of the weights, half of their product with its gradient
    reached = (nearest < REACH**2) & (targets[:, 0] > 0)
    return DepthSums(twice - 0.5 * twice.detach(), (weights * window).sum(-1), reached)
