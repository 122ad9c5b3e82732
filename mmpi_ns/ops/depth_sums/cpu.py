"""Sums over the samples of rays, compiled: ``depth_sums.cpp``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.depth_sums import DepthSums
from mmpi_ns.ops.layout import dense


class _DepthSums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scale: float, valid: Tensor, *floats: Tensor) -> tuple[Tensor, ...]:
        rays, slots = valid.shape
        arrays = [*dense(valid, dtype=torch.bool), *dense(*floats)]
        sums = [*torch.empty(2, rays), torch.empty(rays, dtype=torch.bool)]
        call_in_parts("mmpi_depth_sums", rays, slots, scale, *arrays, *sums)
        ctx.save_for_backward(*arrays)
        ctx.scale = scale
        ctx.mark_non_differentiable(sums[2])
        return tuple(sums)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        valid, weights, *_ = saved = ctx.saved_tensors
        gradient = torch.empty_like(weights)
        call_in_parts("mmpi_depth_sums_back", *valid.shape, ctx.scale, *saved, *dense(*grad_outputs[:2]), gradient)
        return None, None, gradient, None, None, None


def depth_sums(
    weights: Tensor, inverse_t: Tensor, valid: Tensor, intervals: Tensor, targets: Tensor, scale: float
) -> DepthSums:
    return DepthSums(*_DepthSums.apply(scale, valid, weights, inverse_t, intervals, targets))  # type: ignore[misc]
