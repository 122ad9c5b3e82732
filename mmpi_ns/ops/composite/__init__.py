"""Volume rendering of merged samples in log space (paper sec. III-B): weights, colour, depth, and the winning head.

Samples of all rays lie in one array, ray behind ray and nearest first; those of ray r are ``starts[r]:starts[r + 1]``,
and what lies behind the last ray belongs to none. A sample stores its optical depth tau = -log(1 - alpha), never alpha:
at alpha = 1 the slope of log(1 - alpha) is infinite, while tau is an ordinary number. All arithmetic is float32 or
wider, also under autocast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.ends import HALF
from mmpi_ns.ops.layout import dense

MOST = 200.0
"""Maximum of a number in ``sum_before``: an optical depth behind which nothing is visible in any precision."""


def ray_numbers(starts: Int[Tensor, "R+1"], count: int) -> Int[Tensor, "N"]:
    """Ray of each of ``count`` samples; R behind the last ray."""
    return torch.repeat_interleave(pad(starts, (0, 1), value=count).diff(), output_size=count)


def sum_by_ray(
    values: Float[Tensor, "N *C"], starts: Int[Tensor, "R+1"], numbers: Int[Tensor, "N"]
) -> Float[Tensor, "R *C"]:
    """Sums over the samples of each ray, with gradients; ``numbers`` are those of ``ray_numbers``."""
    return values.new_zeros(len(starts), *values.shape[1:]).index_add(0, numbers, values)[:-1]


def sum_before(values: Float[Tensor, "N *C"], starts: Int[Tensor, "R+1"], numbers: Int[Tensor, "N"]) -> Tensor:
    """Sum of all earlier samples on the ray [N, *C], in float64, with gradients.

    It is a difference of sums over all rays. So that no ray spoils the others, numbers beyond ``MOST`` count as that,
    and what is no number as 0.
    """
    total = values.double().nan_to_num(0.0, MOST).clamp(max=MOST).cumsum(0)
    total = pad(total, (0, 0) * (values.ndim - 1) + (1, 0))
    return total[:-1] - total[starts][numbers]


@dataclass(frozen=True)
class Composite:
    """Weights of the samples [N]; their sums, accumulation and transmittance of the rays [R, 1]."""

    weights: Float[Tensor, "N"]
    """T_k alpha'_k of the kept samples."""
    mass: Float[Tensor, "R 1"]
    """Sum of the weights."""
    accumulation: Float[Tensor, "R 1"]
    """1 - transmittance, with the dropped samples."""
    transmittance: Float[Tensor, "R 1"]
    """Behind the last sample."""


@operation("gpu")
def composite_weights(
    tau: Float[Tensor, "N"],
    starts: Int[Tensor, "R+1"],
    skipped_before: Float[Tensor, "N"],
    skipped_total: Float[Tensor, "R 1"],
) -> Composite:
    """Volume-rendering weights of merged samples, sorted by distance; with gradients to ``tau``.

    Args:
        tau: blended optical depths of the samples that were kept.
        starts: of the rays' samples.
        skipped_before: optical depth of the dropped samples in front of each kept one (a constant).
        skipped_total: optical depth of all dropped samples of the ray.

    Returns:
        Weights T_k (1 - exp(-tau_k)), 0 behind the last ray, and what they add up to.

    Source: paper eq. (rendering) and its blended form in sec. III-C.
    """
    numbers = ray_numbers(starts, len(tau))
    tau = tau.masked_fill(numbers == len(starts) - 1, 0.0)
    before = sum_before(tau, starts, numbers).to(tau.dtype)
    weights = -(torch.exp(-before - skipped_before) * torch.expm1(-tau))
    mass, depth = sum_by_ray(torch.stack([weights, tau], -1).double(), starts, numbers).to(tau.dtype).split(1, -1)
    log = -(depth + skipped_total)
    return Composite(weights, mass, -torch.expm1(log), torch.exp(log))


class _CompositeWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tau: Tensor, starts: Tensor, before: Tensor, total: Tensor) -> tuple[Tensor, ...]:
        (weights, behind), (mass, depth) = torch.zeros(2, len(tau)), torch.empty(2, *total.shape)
        call_in_parts("mmpi_composite", len(total), tau, starts, before, total, weights, behind, mass, depth)
        ctx.save_for_backward(starts, weights, behind)
        return weights, mass, depth

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        starts, weights, behind = ctx.saved_tensors
        grads, gradient = (x.contiguous() for x in grad_outputs), torch.zeros_like(weights)
        call_in_parts("mmpi_composite_back", len(starts) - 1, starts, weights, behind, *grads, gradient)
        return gradient, None, None, None


@composite_weights.on_cpu
def composite_weights_on_cpu(tau: Tensor, starts: Tensor, skipped_before: Tensor, skipped_total: Tensor) -> Composite:
    tensors = (*dense(tau), starts.contiguous(), *dense(skipped_before, skipped_total))
    weights, mass, depth = _CompositeWeights.apply(*tensors)  # type: ignore[misc]
    log = -depth
    return Composite(weights, mass, -torch.expm1(log), torch.exp(log))


def render_colors(
    composite: Composite, colors: Float[Tensor, "N 3"], starts: Int[Tensor, "R+1"]
) -> Float[Tensor, "R 3"]:
    """Colour gathered along each ray, without background, with gradients to weights and colours.

    The weight of the dropped samples takes the mean colour of the kept ones (a constant factor per ray), so pruning
    does not darken the image.
    """
    kept = composite.mass
    factor = torch.where(kept > 1e-6, composite.accumulation / kept.clamp(min=1e-6), torch.ones_like(kept))
    sums = sum_by_ray(composite.weights[:, None] * colors, starts, ray_numbers(starts, len(colors)))
    return factor.detach() * sums


@torch.no_grad()
def median_inverse_distance(
    weights: Float[Tensor, "N"], inverse_t: Float[Tensor, "N"], starts: Int[Tensor, "R+1"]
) -> Float[Tensor, "R 1"]:
    """1/t of the sample at which a ray reaches half of its accumulated weight; 0 (infinity) for an empty ray.

    Independent of the other rays, and so of the chunks of an image.
    """
    numbers = ray_numbers(starts, len(weights))
    mass = sum_by_ray(weights.double(), starts, numbers)
    shares = weights / pad(mass, (0, 1), value=1.0)[numbers]
    # As many samples lie before it as have not reached half, but for roundings.
    not_reached = sum_before(shares, starts, numbers) + shares < HALF - 1e-9
    index = starts[:-1] + sum_by_ray(not_reached.long(), starts, numbers)
    return pad(inverse_t, (0, 1))[torch.where(mass > 0, index.clamp(max=len(weights)), len(weights))][:, None]


def winning_heads(
    weights: Float[Tensor, "N"], heads: Int[Tensor, "N"], starts: Int[Tensor, "R+1"], num_heads: int
) -> Float[Tensor, "R 1"]:
    """Head with the largest weight on each ray, for nerfstudio's images; the first of equal ones."""
    mass = weights.new_zeros(len(starts) * num_heads)
    mass = mass.index_add(0, ray_numbers(starts, len(weights)) * num_heads + heads, weights)
    return mass.view(-1, num_heads)[:-1].argmax(-1, keepdim=True).to(weights.dtype)
