"""Volume rendering of merged samples, compiled: ``composite.cpp``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mmpi_ns.ops.build import address, addresses, in_parts, library, sizes
from mmpi_ns.ops.composite.reference import Composite


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tau: Tensor, valid: Tensor, before: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
        weights, depth = torch.empty_like(tau), torch.empty_like(total)
        given, made, lib = addresses((tau, valid, before, total)), addresses((weights, depth)), library()
        in_parts(lambda a, b: lib.mmpi_composite(*given, *sizes(a, b, tau.shape[1]), *made), len(tau))
        ctx.save_for_backward(tau, valid, before, weights)
        return weights, depth

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        tau, valid, before, weights = ctx.saved_tensors
        grads, grad, lib = [g.contiguous() for g in grad_outputs], torch.empty_like(tau), library()
        given, made = addresses((tau, valid, before, weights, *grads)), address(grad)
        in_parts(lambda a, b: lib.mmpi_composite_back(*given, *sizes(a, b, tau.shape[1]), made), len(tau))
        return grad, None, None, None


class _GatheredColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, colors: Tensor) -> Tensor:
        sums, lib = torch.empty(len(weights), 3), library()
        given, made = addresses((weights, colors)), address(sums)
        in_parts(lambda a, b: lib.mmpi_gather_colors(*given, *sizes(a, b, weights.shape[1]), made), len(weights))
        ctx.save_for_backward(weights, colors)
        return sums

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor]:
        weights, colors = ctx.saved_tensors
        grad, grads, lib = (
            grad_outputs[0].contiguous(),
            (torch.empty_like(weights), torch.empty_like(colors)),
            library(),
        )
        given, made, slots = addresses((weights, colors, grad)), addresses(grads), weights.shape[1]
        in_parts(lambda a, b: lib.mmpi_gather_colors_back(*given, *sizes(a, b, slots), *made), len(weights))
        return grads


def composite_weights(tau: Tensor, valid: Tensor, skipped_before: Tensor, skipped_total: Tensor) -> Composite:
    """See ``ops.composite``."""
    weights, depth = _Weights.apply(*(x.contiguous() for x in (tau, valid, skipped_before, skipped_total)))  # type: ignore[misc]
    return Composite(weights, -torch.expm1(-depth), torch.exp(-depth))


def gather_colors(weights: Tensor, colors: Tensor) -> Tensor:
    """See ``ops.composite.reference``."""
    return _GatheredColors.apply(weights.contiguous(), colors.contiguous())  # type: ignore[no-any-return]


def median_inverse_distance(weights: Tensor, inverse_t: Tensor, valid: Tensor) -> Tensor:
    """See ``ops.composite``."""
    held, median, lib = [x.contiguous() for x in (weights, inverse_t, valid)], torch.empty(len(weights), 1), library()
    given, made = addresses(held), address(median)
    in_parts(lambda a, b: lib.mmpi_median(*given, *sizes(a, b, weights.shape[1]), made), len(weights))
    return median


def winning_heads(weights: Tensor, heads: Tensor, num_heads: int) -> Tensor:
    """See ``ops.composite``."""
    held, winners, lib = (weights.contiguous(), heads.long().contiguous()), torch.empty(len(weights), 1), library()
    given, made = addresses(held), address(winners)
    in_parts(lambda a, b: lib.mmpi_winners(*given, *sizes(a, b, weights.shape[1], num_heads), made), len(weights))
    return winners
