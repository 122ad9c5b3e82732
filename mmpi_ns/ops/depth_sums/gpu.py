"""Sums of the depth losses on a GPU, with their gradients; a lane a ray."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.depth_sums import REACH, DepthSums
from mmpi_ns.ops.gpu_scene import block_size, launch, samples_of
from mmpi_ns.ops.layout import dense

RAYS = 32
"""Rays per program, of one warp."""


@triton.jit
def _read(weights, inverse_ts, at, has, scale):
    """Weights and positions s of samples, in float64: differences of their sums agree in most digits."""
    inverse_t = tl.load(inverse_ts + at, has, 0.0)
    return tl.load(weights + at, has, 0.0).to(tl.float64), (1 / (1 + scale * inverse_t)).to(tl.float64), inverse_t


@triton.jit(do_not_specialize=("num_rays",))
def depth_sums_kernel(
    weights, inverse_ts, starts, intervals, targets, spreads, masses, reached, slopes, windows, num_rays, scale, reach,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Spread and mass, whether a sample is near the target, and the gradients of both by the weights."""
    ray, inside, start, count = samples_of(starts, num_rays, BLOCK)
    target, width = tl.load(targets + 2 * ray, inside, 0.0), tl.load(targets + 2 * ray + 1, inside, 1.0)
    interval, zero = tl.load(intervals + ray, inside, 0.0), ray.to(tl.float64) * 0.0
    total, moments, passed, moment, product, mass, near = zero, zero, zero, zero, zero, ray * 0.0, ray < 0
    for s in range(tl.max(count, 0)):
        at, has = start + s, s < count
        weight, position, inverse_t = _read(weights, inverse_ts, at, has, scale)
        away = (inverse_t - target) / width
        near = near | (has & (away * away < reach))
        window = tl.exp(-0.5 * tl.minimum(away * away, 120.0))
        tl.store(windows + at, window, has)
        total += weight
        moments += weight * position
        mass += weight.to(tl.float32) * window
    for s in range(tl.max(count, 0)):
        at, has = start + s, s < count
        weight, position, _ = _read(weights, inverse_ts, at, has, scale)
        passed += weight
        moment += weight * position
        pairs = (2 * passed - total) * position + moments - 2 * moment
        slope = 2 * pairs + 2.0 / 3 * weight * interval
        tl.store(slopes + at, slope.to(tl.float32), has)
        product += weight * slope
    tl.store(spreads + ray, (product / 2).to(tl.float32), inside)
    tl.store(masses + ray, mass, inside)
    tl.store(reached + ray, near & (target > 0), inside)


@triton.jit(do_not_specialize=("num_rays",))
def depth_sums_back_kernel(starts, slopes, windows, to_spread, to_mass, gradient, num_rays, BLOCK: tl.constexpr):
    """Gradient of the weights."""
    ray, inside, start, count = samples_of(starts, num_rays, BLOCK)
    of_spread, of_mass = tl.load(to_spread + ray, inside, 0.0), tl.load(to_mass + ray, inside, 0.0)
    for s in range(tl.max(count, 0)):
        at, has = start + s, s < count
        sloped = of_spread * tl.load(slopes + at, has, 0.0)
        tl.store(gradient + at, sloped + of_mass * tl.load(windows + at, has, 0.0), has)


class _DepthSums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, inverse_t: Tensor, starts: Tensor, *rays: Any) -> tuple[Tensor, ...]:
        *of_rays, scale = rays
        count, device, block = len(starts) - 1, weights.device, block_size(RAYS, weights.device)
        slopes, windows = torch.empty(2, len(weights), device=device)
        spread, mass = torch.empty(2, count, device=device)
        reached = torch.empty(count, dtype=torch.bool, device=device)
        tensors = (weights, inverse_t, starts, *of_rays, spread, mass, reached, slopes, windows)
        launch(depth_sums_kernel, count, block, *tensors, count, scale, REACH**2, BLOCK=block, num_warps=1)
        ctx.save_for_backward(starts, slopes, windows)
        ctx.mark_non_differentiable(reached)
        return spread, mass, reached

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        starts, slopes, windows = ctx.saved_tensors
        gradient, block = torch.zeros_like(slopes), block_size(RAYS, slopes.device)
        tensors = (starts, slopes, windows, *(x.contiguous() for x in grad_outputs[:2]), gradient)
        launch(depth_sums_back_kernel, len(starts) - 1, block, *tensors, len(starts) - 1, BLOCK=block, num_warps=1)
        return gradient, None, None, None, None, None


def depth_sums(
    weights: Tensor, inverse_t: Tensor, starts: Tensor, intervals: Tensor, targets: Tensor, scale: float
) -> DepthSums:
    tensors = (*dense(weights, inverse_t), starts.contiguous(), *dense(intervals, targets))
    return DepthSums(*_DepthSums.apply(*tensors, float(scale)))  # type: ignore[misc]
