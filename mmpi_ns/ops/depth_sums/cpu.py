"""Sums over the samples of rays, compiled: ``depth_sums.cpp``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.depth_sums import DepthSums
from mmpi_ns.ops.layout import shaped


class _DepthSums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, inverse_t: Tensor, *others: Any) -> tuple[Tensor, ...]:
        valid, intervals, targets, scale = others
        rays, slots = weights.shape
        samples = shaped(weights, rays, slots), shaped(inverse_t, rays, slots)
        each = shaped(valid, rays, slots, dtype=torch.bool), shaped(intervals, rays), shaped(targets, rays, 2)
        sums = [torch.empty(rays), torch.empty(rays), torch.empty(rays, dtype=torch.bool)]
        call_in_parts("mmpi_depth_sums", rays, (*samples, *each), (slots, scale, *sums))
        ctx.save_for_backward(*samples, *each)
        ctx.scale = scale
        ctx.mark_non_differentiable(sums[2])
        return tuple(sums)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        weights, *_ = saved = ctx.saved_tensors
        rays, slots = weights.shape
        grads, gradient = [shaped(g, rays) for g in grad_outputs[:2]], torch.empty_like(weights)
        call_in_parts("mmpi_depth_sums_back", rays, (*saved, *grads), (slots, ctx.scale, gradient))
        return gradient, None, None, None, None, None


def depth_sums(
    weights: Tensor, inverse_t: Tensor, valid: Tensor, intervals: Tensor, targets: Tensor, scale: float
) -> DepthSums:
    return DepthSums(*_DepthSums.apply(weights, inverse_t, valid, intervals, targets, scale))  # type: ignore[misc]
