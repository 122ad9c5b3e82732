"""Sums over a ray's samples for the depth losses: the spread of its weights, and their mass near a depth prior."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.composite import Run, exclusive_cumsum
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
    positions = 1 / (1 + scale * inverse_t)
    before, moment_before = exclusive_cumsum(weights), exclusive_cumsum(weights * positions)
    spread = 2 * (weights * (positions * before - moment_before)).sum(-1) + (weights**2).sum(-1) * intervals / 3
    scaled = (inverse_t - targets[:, :1]) / targets[:, 1:]
    # Bounded from below, since exponentials that underflow take far longer.
    window = torch.where(valid, torch.exp(-0.5 * scaled.square().clamp(max=120)), torch.zeros_like(scaled))
    reached = (valid & (scaled.abs() < REACH)).any(-1) & (targets[:, 0] > 0)
    return DepthSums(spread, (weights * window).sum(-1), reached)


class _DepthSums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, run: Run, back: Run, scale: float, *arrays: Tensor) -> tuple[Tensor, ...]:
        valid, weights, *_ = arrays
        sums = [*weights.new_empty(2, len(valid)), torch.empty_like(valid[:, 0])]
        run(*valid.shape, scale, *arrays, *sums)
        ctx.save_for_backward(*arrays)
        ctx.back, ctx.scale = back, scale
        ctx.mark_non_differentiable(sums[2])
        return tuple(sums)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        valid, weights, *_ = saved = ctx.saved_tensors
        gradient = torch.empty_like(weights)
        ctx.back(*valid.shape, ctx.scale, *saved, *dense(*grad_outputs[:2]), gradient)
        return None, None, None, None, gradient, None, None, None


def compiled_sums(
    run: Run,
    back: Run,
    weights: Tensor,
    inverse_t: Tensor,
    valid: Tensor,
    intervals: Tensor,
    targets: Tensor,
    scale: float,
) -> DepthSums:
    """``depth_sums`` by compiled code, which takes sizes, scale, inputs and outputs."""
    arrays = [*dense(valid, dtype=torch.bool), *dense(weights, inverse_t, intervals, targets)]
    return DepthSums(*_DepthSums.apply(run, back, float(scale), *arrays))  # type: ignore[misc]


depth_sums.on_cpu(
    partial(compiled_sums, *(partial(call_in_parts, name) for name in ("mmpi_depth_sums", "mmpi_depth_sums_back")))
)
