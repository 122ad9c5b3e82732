"""Volume rendering of merged samples, compiled: ``composite.cpp``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.composite import Composite, checked
from mmpi_ns.ops.layout import shaped


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tau: Tensor, valid: Tensor, before: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
        weights, depth = torch.empty_like(tau), torch.empty_like(total)
        call_in_parts("mmpi_composite", len(tau), (tau, valid, before, total), (tau.shape[1], weights, depth))
        ctx.save_for_backward(tau, valid, before, weights)
        return weights, depth

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        tau, *_ = saved = ctx.saved_tensors
        grad, grads = (
            torch.empty_like(tau),
            [shaped(g, len(tau), n) for g, n in zip(grad_outputs, (tau.shape[1], 1), strict=True)],
        )
        call_in_parts("mmpi_composite_back", len(tau), (*saved, *grads), (tau.shape[1], grad))
        return grad, None, None, None


def composite_weights(tau: Tensor, valid: Tensor, skipped_before: Tensor, skipped_total: Tensor) -> Composite:
    weights, depth = _Weights.apply(*checked(tau, valid, skipped_before, skipped_total))  # type: ignore[misc]
    return Composite(weights, -torch.expm1(-depth), torch.exp(-depth))
