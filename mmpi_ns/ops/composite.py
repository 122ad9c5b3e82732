"""Compositing: the functions of ``compositing.py``, or their fused forms."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops import compositing, native
from mmpi_ns.ops.compositing import Composite


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, lib: ctypes.CDLL, tau: Tensor, valid: Tensor, before: Tensor, total: Tensor
    ) -> tuple[Tensor, Tensor]:
        weights, depth = torch.empty_like(tau), torch.empty_like(total)
        given = [native.address(x, x.dtype) for x in (tau, valid, before, total)]
        places = [native.address(x) for x in (weights, depth)]

        def part(begin: int, end: int) -> None:
            lib.mmpi_composite(*given, *map(ctypes.c_int64, (begin, end, tau.shape[1])), *places)

        native.in_parts(part, len(tau))
        ctx.save_for_backward(tau, valid, before, weights)
        ctx.lib = lib
        return weights, depth

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        tau, valid, before, weights = ctx.saved_tensors
        grads, grad = [g.contiguous() for g in grad_outputs], torch.empty_like(tau)
        given = [native.address(x, x.dtype) for x in (tau, valid, before, weights, *grads)]

        def part(begin: int, end: int) -> None:
            sizes = map(ctypes.c_int64, (begin, end, tau.shape[1]))
            ctx.lib.mmpi_composite_back(*given, *sizes, native.address(grad))

        native.in_parts(part, len(tau))
        return None, grad, None, None, None


class _GatheredColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lib: ctypes.CDLL, weights: Tensor, colors: Tensor) -> Tensor:
        sums = torch.empty(len(weights), 3)
        given = [native.address(x) for x in (weights, colors)]

        def part(begin: int, end: int) -> None:
            sizes = map(ctypes.c_int64, (begin, end, weights.shape[1]))
            lib.mmpi_gather_colors(*given, *sizes, native.address(sums))

        native.in_parts(part, len(weights))
        ctx.save_for_backward(weights, colors)
        ctx.lib = lib
        return sums

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        weights, colors = ctx.saved_tensors
        grad, to_weights, to_colors = grad_outputs[0].contiguous(), torch.empty_like(weights), torch.empty_like(colors)
        given = [native.address(x) for x in (weights, colors, grad)]

        def part(begin: int, end: int) -> None:
            sizes = map(ctypes.c_int64, (begin, end, weights.shape[1]))
            ctx.lib.mmpi_gather_colors_back(*given, *sizes, *map(native.address, (to_weights, to_colors)))

        native.in_parts(part, len(weights))
        return None, to_weights, to_colors


def composite_weights(
    tau: Float[Tensor, "R S"],
    valid: Bool[Tensor, "R S"],
    skipped_before: Float[Tensor, "R S"],
    skipped_total: Float[Tensor, "R 1"],
) -> Composite:
    """See ``compositing.composite_weights``; only ``tau`` has gradients."""
    if native.takes_triton(tau):
        from mmpi_ns.ops import triton_composite

        return triton_composite.composite_weights(tau, valid, skipped_before, skipped_total)
    lib = native.library(tau, skipped_before, skipped_total)
    if lib is None:
        return compositing.composite_weights(tau, valid, skipped_before, skipped_total)
    parts = (x.contiguous() for x in (tau, valid, skipped_before, skipped_total))
    weights, depth = _Weights.apply(lib, *parts)  # type: ignore[misc]
    return Composite(weights, -torch.expm1(-depth), torch.exp(-depth))


def render_colors(composite: Composite, colors: Float[Tensor, "R S 3"]) -> Float[Tensor, "R 3"]:
    """See ``compositing.render_colors``."""
    lib = native.library(composite.weights, colors)
    if lib is None:
        return compositing.render_colors(composite, colors)
    sums = _GatheredColors.apply(lib, composite.weights.contiguous(), colors.contiguous())
    return compositing.fill_up(composite, sums)  # type: ignore[arg-type]


def median_inverse_distance(
    weights: Float[Tensor, "R S"], inverse_t: Float[Tensor, "R S"], valid: Bool[Tensor, "R S"]
) -> Float[Tensor, "R 1"]:
    """See ``compositing.median_inverse_distance``."""
    lib = native.library(weights, inverse_t)
    if lib is None or torch.is_grad_enabled():
        return compositing.median_inverse_distance(weights, inverse_t, valid)
    held = [x.contiguous() for x in (weights, inverse_t, valid)]
    median = torch.empty(len(weights), 1)

    def part(begin: int, end: int) -> None:
        sizes = map(ctypes.c_int64, (begin, end, weights.shape[1]))
        lib.mmpi_median(*(native.address(x, x.dtype) for x in held), *sizes, native.address(median))

    native.in_parts(part, len(weights))
    return median


def winning_heads(weights: Float[Tensor, "R S"], heads: Int[Tensor, "R S"], num_heads: int) -> Float[Tensor, "R 1"]:
    """The head that gives each ray most of its weight, as nerfstudio's images take it; the first of equals."""
    lib = native.library(weights) if heads.dtype == torch.int64 else None
    if lib is None:
        mass = weights.new_zeros(len(weights), num_heads).scatter_add(1, heads, weights)
        return mass.argmax(-1, keepdim=True).to(weights.dtype)
    held, winners = [x.contiguous() for x in (weights, heads)], torch.empty(len(weights), 1)

    def part(begin: int, end: int) -> None:
        sizes = map(ctypes.c_int64, (begin, end, weights.shape[1], num_heads))
        lib.mmpi_winners(*(native.address(x, x.dtype) for x in held), *sizes, native.address(winners))

    native.in_parts(part, len(weights))
    return winners
