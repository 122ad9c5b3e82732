"""Rendering weights of rays on a GPU, with their gradients; a lane a ray."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.composite import Composite
from mmpi_ns.ops.gpu_scene import block_size, launch, one_minus_exp, samples_of
from mmpi_ns.ops.layout import dense

RAYS = 32
"""Rays per program, of one warp."""


@triton.jit(do_not_specialize=("num_rays",))
def composite_kernel(
    taus, starts, skipped_before, skipped_total, weights, behind, masses, accumulations, transmittances, num_rays,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Weights of the samples and transmittance behind each, and what they add up to."""
    ray, inside, start, count = samples_of(starts, num_rays, BLOCK)
    depth, mass = ray * 0.0, ray * 0.0
    for s in range(tl.max(count, 0)):
        at, has = start + s, s < count
        tau = tl.load(taus + at, has, 0.0)
        in_front = tl.exp(-(depth + tl.load(skipped_before + at, has, 0.0)))
        weight = in_front * one_minus_exp(tau)
        tl.store(weights + at, weight, has)
        tl.store(behind + at, in_front * tl.exp(-tau), has)
        mass += tl.where(has, weight, 0.0)
        depth += tau
    depth += tl.load(skipped_total + ray, inside, 0.0)
    tl.store(masses + ray, mass, inside)
    tl.store(accumulations + ray, one_minus_exp(depth), inside)
    tl.store(transmittances + ray, tl.exp(-depth), inside)


@triton.jit(do_not_specialize=("num_rays",))
def composite_back_kernel(
    starts, weights, behind, transmittances, to_weights, to_mass, to_accumulation, to_transmittance, gradient, num_rays,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradient of the optical depths, from the last sample of a ray to the first."""
    ray, inside, start, count = samples_of(starts, num_rays, BLOCK)
    to_all, transmittance = tl.load(to_mass + ray, inside, 0.0), tl.load(transmittances + ray, inside, 0.0)
    of_depth = tl.load(to_accumulation + ray, inside, 0.0) - tl.load(to_transmittance + ray, inside, 0.0)
    of_depth *= transmittance
    later = ray.to(tl.float64) * 0.0  # what the weights behind lose
    for s in range(tl.max(count, 0)):
        at, has = start + count - 1 - s, s < count
        slope = (tl.load(to_weights + at, has, 0.0) + to_all).to(tl.float64)
        through = tl.load(behind + at, has, 0.0)
        tl.store(gradient + at, (slope * through - later + of_depth).to(tl.float32), has)
        later += slope * tl.load(weights + at, has, 0.0)


class _CompositeWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tau: Tensor, starts: Tensor, before: Tensor, total: Tensor) -> tuple[Tensor, ...]:
        weights, behind = torch.zeros(2, len(tau), device=tau.device)
        of_rays = mass, accumulation, transmittance = torch.empty(3, *total.shape, device=tau.device)
        block = block_size(RAYS, tau.device)
        tensors = (tau, starts, before, total, weights, behind, *of_rays)
        launch(composite_kernel, len(total), block, *tensors, len(total), BLOCK=block, num_warps=1)
        ctx.save_for_backward(starts, weights, behind, transmittance)
        return weights, mass, accumulation, transmittance

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        starts, weights, *_ = saved = ctx.saved_tensors
        gradient, block = torch.zeros_like(weights), block_size(RAYS, weights.device)
        tensors = (*saved, *(x.contiguous() for x in grad_outputs), gradient)
        launch(composite_back_kernel, len(starts) - 1, block, *tensors, len(starts) - 1, BLOCK=block, num_warps=1)
        return gradient, None, None, None


def composite_weights(tau: Tensor, starts: Tensor, skipped_before: Tensor, skipped_total: Tensor) -> Composite:
    tensors = (*dense(tau), starts.contiguous(), *dense(skipped_before, skipped_total))
    return Composite(*_CompositeWeights.apply(*tensors))  # type: ignore[misc]
