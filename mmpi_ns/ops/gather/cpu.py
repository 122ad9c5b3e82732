"""What rays gather of the texels along them, compiled: ``gather.cpp``."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import call_in_parts, owned_bounds, run_in_parts, structs
from mmpi_ns.ops.gather import COLORS, RaySums, Taps, split_sums

LANES = 16
"""Gradients of sums are padded to multiples of this many channels."""
AT_LEAST = 1 << 14
"""Texels read that are worth another thread."""


def _groups(taps: list[Tensor], to_weights: Sequence[Tensor | None] = (None, None)) -> ctypes.Array:
    """The taps of planes, then those of the cube, with the gradients of their weights: ``Taps`` of ``gather.cpp``."""
    groups: list[tuple] = [(None, None, 0, None)] * 2
    for positions, weights, to in zip(taps[::2], taps[1::2], to_weights, strict=False):
        groups[positions.shape[1] // 8] = (positions, weights, len(positions), to)
    return structs(*groups)


class _GatherTaps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, weights: Tensor, slots: Tensor, chosen: Tensor, *taps: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        (num_rays, width), channels = weights.shape, values.shape[1]
        saved = [x.contiguous() for x in (values, weights, slots, chosen, *taps)]
        values, weights, slots, chosen = saved[:4]
        numbers = torch.full((num_rays, width), -1, dtype=torch.int32)
        call_in_parts("mmpi_number_samples", len(slots), slots, chosen, width, numbers, least=AT_LEAST)
        sums = torch.empty(num_rays, channels + 1 + COLORS)
        samples = (_groups(saved[4:]), numbers, weights, width)
        call_in_parts("mmpi_gather_taps", num_rays, values, *values.shape, *samples, sums)
        ctx.save_for_backward(*saved)
        parts = split_sums(sums, channels)
        ctx.mark_non_differentiable(parts[1])
        return parts

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        values, weights, slots, chosen, *taps = ctx.saved_tensors
        to_sums, _, to_first, to_second = grad_outputs
        to_values = torch.empty_like(values) if ctx.needs_input_grad[0] else None
        to_weights = torch.zeros_like(weights)
        moved = zip(taps[1::2], ctx.needs_input_grad[5::2], strict=True)
        to_taps = [torch.zeros_like(x) if moves else None for x, moves in moved]
        batch = (values, *values.shape, _groups(taps, to_taps), slots, chosen, weights)
        grads = [pad(g, (0, -g.shape[1] % LANES)).contiguous() for g in (to_sums, to_first, 2 * to_second)]
        bounds = owned_bounds(taps[::2], len(values), AT_LEAST)
        run_in_parts("mmpi_gather_back", bounds, *batch, *grads, weights.shape[1], to_values, to_weights)
        return to_values, to_weights, None, None, *(x for to in to_taps for x in (None, to))


def gather_taps(values: Tensor, taps: list[Taps], slots: Tensor, weights: Tensor, chosen: Tensor) -> RaySums:
    """Gradients do not depend on the number of threads."""
    tensors = [x for t in taps for x in (t.positions.to(torch.int32), t.weights)]
    return RaySums(*_GatherTaps.apply(values, weights, slots, chosen, *tensors))  # type: ignore[misc]
