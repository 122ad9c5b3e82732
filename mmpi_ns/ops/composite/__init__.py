"""Volume rendering of merged samples in log space (paper sec. III-B): weights, colour, depth, and the winning head.

A sample stores its optical depth tau = -log(1 - alpha), never alpha: at alpha = 1 the slope of log(1 - alpha) is
infinite, while tau is an ordinary number. All arithmetic is float32 or wider, also under autocast.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops.ends import HALF


def exclusive_cumsum(values: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """Sum of all earlier samples on the ray. Shifted, not subtracted: x - x loses small terms before a large x."""
    shifted = torch.nn.functional.pad(values[:, :-1], (1, 0))
    return shifted.cumsum(-1)


@dataclass(frozen=True)
class Composite:
    """Weights of the samples [R, S]; accumulation and transmittance of the rays [R, 1]."""

    weights: Float[Tensor, "R S"]
    """T_k alpha'_k of the kept samples."""
    accumulation: Float[Tensor, "R 1"]
    """1 - transmittance, with the dropped samples."""
    transmittance: Float[Tensor, "R 1"]
    """Behind the last sample."""


def composite_weights(
    tau: Float[Tensor, "R S"],
    valid: Bool[Tensor, "R S"],
    skipped_before: Float[Tensor, "R S"],
    skipped_total: Float[Tensor, "R 1"],
) -> Composite:
    """Volume-rendering weights of merged samples, sorted by distance; with gradients to ``tau``.

    Args:
        tau: blended optical depths of the samples that were kept.
        valid: which slots hold a sample.
        skipped_before: optical depth of the dropped samples in front of each kept one (a constant).
        skipped_total: optical depth of all dropped samples of the ray.

    Returns:
        Weights T_k (1 - exp(-tau_k)), accumulation and transmittance.

    Source: paper eq. (rendering) and its blended form in sec. III-C.
    """
    tau = torch.where(valid, tau, 0.0)
    through = -tau
    weights = -(torch.exp(exclusive_cumsum(through) - skipped_before) * torch.expm1(through))
    depth = tau.sum(-1, keepdim=True) + skipped_total
    return Composite(weights, -torch.expm1(-depth), torch.exp(-depth))


def render_colors(composite: Composite, colors: Float[Tensor, "R S 3"]) -> Float[Tensor, "R 3"]:
    """Colour gathered along each ray, without background, with gradients to weights and colours.

    The weight of the dropped samples takes the mean colour of the kept ones (a constant factor per ray), so pruning
    does not darken the image.
    """
    kept = composite.weights.sum(-1, keepdim=True)
    factor = torch.where(kept > 1e-6, composite.accumulation / kept.clamp(min=1e-6), torch.ones_like(kept))
    return factor.detach() * (composite.weights[..., None] * colors).sum(-2)


@torch.no_grad()
def median_inverse_distance(
    weights: Float[Tensor, "R S"], inverse_t: Float[Tensor, "R S"], valid: Bool[Tensor, "R S"]
) -> Float[Tensor, "R 1"]:
    """1/t of the sample at which a ray reaches half of its accumulated weight; 0 (infinity) for an empty ray.

    Independent of the other rays, and so of the chunks of an image.
    """
    gathered = weights.cumsum(-1)
    total = gathered[:, -1:]
    reached = (gathered >= HALF * total) & valid & (total > 0)
    index = reached.to(torch.int8).argmax(-1, keepdim=True)
    picked = inverse_t.gather(-1, index)
    return torch.where(reached.any(-1, keepdim=True), picked, torch.zeros_like(picked))


def winning_heads(weights: Float[Tensor, "R S"], heads: Int[Tensor, "R S"], num_heads: int) -> Float[Tensor, "R 1"]:
    """Head with the largest weight on each ray, for nerfstudio's images; the first of equal ones."""
    mass = weights.new_zeros(len(weights), num_heads).scatter_add(1, heads, weights)
    return mass.argmax(-1, keepdim=True).to(weights.dtype)
