"""Sums over the samples of each ray for the losses of depth."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.composite import ray_numbers, sum_before, sum_by_ray
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.layout import dense

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


@operation("gpu")
def depth_sums(
    weights: Float[Tensor, "N"],
    inverse_t: Float[Tensor, "N"],
    starts: Int[Tensor, "R+1"],
    intervals: Float[Tensor, "R"],
    targets: Float[Tensor, "R 2"],
    scale: float,
) -> DepthSums:
    """Spread and mass of each ray, with gradients to the weights of its samples.

    Args:
        weights: rendering weights, 0 behind the last ray.
        inverse_t: inverse distances of the samples, front to back.
        starts: of the rays' samples.
        intervals: delta, the length of a ray's samples on the map s.
        targets: inverse distance of the depth prior, 0 for none, and the width of the window around it (> 0).
        scale: distance that s maps to 1/2.

    Source: spread: mip-NeRF 360 eq. (15), in O(S) a ray by prefix sums as in DVGO v2.
    """
    numbers = ray_numbers(starts, len(weights))
    of_rays = numbers.clamp(max=max(0, len(intervals) - 1))
    with torch.no_grad():
        positions = (1 + scale * inverse_t).reciprocal()
        weighted = weights * positions
        each = torch.stack([weights, weighted], -1).double()
        before, moment = sum_before(each, starts, numbers).unbind(-1)
        total, moments = sum_by_ray(each, starts, numbers)[of_rays].unbind(-1)
        pairs = (2 * (before + weights) - total) * positions + moments - 2 * (moment + weighted)
        slope = (2 * pairs + 2 / 3 * weights * intervals[of_rays]).to(weights.dtype)
        away = ((inverse_t - targets[of_rays, 0]) / targets[of_rays, 1]) ** 2
        within = sum_by_ray((away < REACH**2).long(), starts, numbers)
        # Bounded from below, since exponentials that underflow take far longer.
        window = torch.exp(-0.5 * away.clamp(max=120))
    # A quadratic form of the weights is half of their product with its gradient.
    twice, mass = sum_by_ray(weights[:, None] * torch.stack([slope, window], -1), starts, numbers).unbind(-1)
    return DepthSums(twice - 0.5 * twice.detach(), mass, (within > 0) & (targets[:, 0] > 0))


class _DepthSums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, inverse_t: Tensor, starts: Tensor, *rays: Any) -> tuple[Tensor, ...]:
        slope, window = torch.zeros_like(weights), torch.zeros_like(weights)
        (spread, mass), reached = torch.empty(2, len(starts) - 1), torch.empty(len(starts) - 1, dtype=torch.bool)
        sums = (spread, mass, reached, slope, window)
        call_in_parts("mmpi_depth_sums", len(spread), weights, inverse_t, starts, *rays, REACH**2, *sums)
        ctx.save_for_backward(starts, slope, window)
        ctx.mark_non_differentiable(reached)
        return spread, mass, reached

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        starts, slope, window = ctx.saved_tensors
        grads, gradient = (x.contiguous() for x in grad_outputs[:2]), torch.zeros_like(slope)
        call_in_parts("mmpi_depth_sums_back", len(starts) - 1, starts, slope, window, *grads, gradient)
        return gradient, None, None, None, None, None


@depth_sums.on_cpu
def depth_sums_on_cpu(
    weights: Tensor, inverse_t: Tensor, starts: Tensor, intervals: Tensor, targets: Tensor, scale: float
) -> DepthSums:
    tensors = (*dense(weights, inverse_t), starts.contiguous(), *dense(intervals, targets))
    return DepthSums(*_DepthSums.apply(*tensors, float(scale)))  # type: ignore[misc]
