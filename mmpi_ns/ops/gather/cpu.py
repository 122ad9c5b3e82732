"""What rays gather of the texels along them, compiled: ``gather.cpp``."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops.build import arguments, call, call_in_parts
from mmpi_ns.ops.gather.reference import COLORS, KnownTaps, RaySums, split_sums

LANES = 16
"""Gradients of sums are padded to multiples of this many channels."""


class _Taps(ctypes.Structure):
    _fields_ = [
        ("positions", ctypes.c_void_p),
        ("shares", ctypes.c_void_p),
        ("count", ctypes.c_int64),
        ("grad_shares", ctypes.c_void_p),
    ]


def _groups(taps: list[Tensor], to_shares: list[Tensor | None] | None = None) -> Any:
    """Taps of planes, then those of the cube, as the kernels take them, and where the gradients of their shares go."""
    found = (_Taps * 2)()
    positions, shares = taps[::2], taps[1::2]
    for position, share, to in zip(positions, shares, to_shares or [None] * len(shares), strict=True):
        found[position.shape[1] // 8] = _Taps(*arguments((position, share, len(position), to)))
    return found


def _pad(grad: Float[Tensor, "R N"]) -> Float[Tensor, "R M"]:
    """With zeros, to whole lanes."""
    return torch.nn.functional.pad(grad, (0, -grad.shape[1] % LANES)).contiguous()


class _GatherTaps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, weights: Tensor, slots: Tensor, wanted: Tensor, *taps: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        (num_rays, width), channels = weights.shape, values.shape[1]
        held = [x.contiguous() for x in (values, weights, slots, wanted, *taps)]
        values, weights, slots, wanted = held[:4]
        numbers = torch.full((num_rays, width), -1, dtype=torch.int32)
        numbers.view(-1)[slots] = torch.arange(len(slots), dtype=torch.int32)
        numbers[~wanted] = -1
        sums = torch.empty(num_rays, channels + 1 + COLORS)
        given = (values, *values.shape, _groups(held[4:]), numbers, weights)
        call_in_parts("mmpi_gather_taps", num_rays, given, (width, sums))
        ctx.save_for_backward(*held)
        found = split_sums(sums, channels)
        ctx.mark_non_differentiable(found[1])
        return found

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        values, weights, slots, wanted, *taps = ctx.saved_tensors
        to_sums, _, to_first, to_second = grad_outputs
        to_values = torch.zeros_like(values) if ctx.needs_input_grad[0] else None
        to_weights = torch.zeros_like(weights)
        needed = zip(taps[1::2], ctx.needs_input_grad[5::2], strict=True)
        to_shares = [torch.zeros_like(x) if moves else None for x, moves in needed]
        given = (values, *values.shape, _groups(taps, to_shares), slots, wanted, weights)
        padded = [_pad(g) for g in (to_sums, to_first, 2 * to_second)]
        call("mmpi_gather_back", *given, *padded, weights.shape[1], to_values, to_weights)
        return to_values, to_weights, None, None, *(x for to in to_shares for x in (None, to))


def gather_taps(values: Tensor, groups: list[KnownTaps], slots: Tensor, weights: Tensor, wanted: Tensor) -> RaySums:
    """See ``ops.gather``. The sum of a gradient does not depend on the number of threads."""
    taps = [x for g in groups for x in (g.positions.to(torch.int32), g.shares)]
    return RaySums(*_GatherTaps.apply(values, weights, slots, wanted, *taps))  # type: ignore[misc]
