"""What rays gather of the texels along them, compiled."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops import build
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.gather.reference import COLORS, KnownTaps, RaySums
from mmpi_ns.ops.layout import SceneLayout

LANES = 16
"""Gradients of sums are padded to multiples of this many channels."""


class _Taps(ctypes.Structure):
    _fields_ = [("positions", ctypes.c_void_p), ("shares", ctypes.c_void_p), ("count", ctypes.c_int64)]


def _groups(positions: list[Tensor], shares: list[Tensor]) -> Any:
    """Taps of planes, then those of the cube, as the kernels take them."""
    found = (_Taps * 2)()
    for position, share in zip(positions, shares, strict=True):
        given = (build.address(position, torch.int32), build.address(share), len(position))
        found[position.shape[1] // 8] = _Taps(*given)
    return found


def _split(sums: Float[Tensor, "R N"], channels: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    gathered, mass, second = sums.split([channels, 1, COLORS], -1)
    return gathered, mass, gathered[:, :COLORS].clone(), second


def _pad(grad: Float[Tensor, "R N"]) -> Float[Tensor, "R M"]:
    """With zeros, to whole lanes."""
    return torch.nn.functional.pad(grad, (0, -grad.shape[1] % LANES)).contiguous()


class _GatherTaps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        lib: ctypes.CDLL,
        values: Tensor,
        weights: Tensor,
        slots: Tensor,
        wanted: Tensor,
        *taps: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        (num_rays, width), channels = weights.shape, values.shape[1]
        held = [x.contiguous() for x in (values, weights, slots, wanted, *taps)]
        values, weights, slots, wanted = held[:4]
        numbers = torch.full((num_rays, width), -1, dtype=torch.int32)
        numbers.view(-1)[slots] = torch.arange(len(slots), dtype=torch.int32)
        numbers[~wanted] = -1
        groups, sums = _groups(held[4::2], held[5::2]), torch.empty(num_rays, channels + 1 + COLORS)

        def part(begin: int, end: int) -> None:
            lib.mmpi_gather_taps(
                build.address(values),
                *map(ctypes.c_int64, values.shape),
                groups,
                build.address(numbers, torch.int32),
                build.address(weights),
                *map(ctypes.c_int64, (begin, end, width)),
                build.address(sums),
            )

        build.in_parts(part, num_rays)
        ctx.save_for_backward(*held)
        ctx.lib = lib
        found = _split(sums, channels)
        ctx.mark_non_differentiable(found[1])
        return found

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        values, weights, slots, wanted, *taps = ctx.saved_tensors
        to_sums, _, to_first, to_second = grad_outputs
        to_values = torch.zeros_like(values) if ctx.needs_input_grad[1] else None
        to_weights = torch.zeros_like(weights)
        padded = [_pad(g) for g in (to_sums, to_first, 2 * to_second)]
        ctx.lib.mmpi_gather_back(
            build.address(values),
            *map(ctypes.c_int64, values.shape),
            _groups(taps[::2], taps[1::2]),
            build.address(slots, torch.int64),
            build.address(wanted, torch.bool),
            build.address(weights),
            *map(build.address, padded),
            ctypes.c_int64(weights.shape[1]),
            None if to_values is None else build.address(to_values),
            build.address(to_weights),
        )
        return None, to_values, to_weights, None, None, *[None] * len(taps)


def gather_taps(
    values: Float[Tensor, "U C"],
    groups: list[KnownTaps],
    slots: Int[Tensor, "N"],
    weights: Float[Tensor, "R S"],
    wanted: Bool[Tensor, "R"],
) -> RaySums:
    """See ``reference.gather_taps``. The sum of a gradient does not depend on the number of threads."""
    taps = [x for g in groups for x in (g.positions.to(torch.int32), g.shares)]
    return RaySums(*_GatherTaps.apply(build.library(), values, weights, slots, wanted, *taps))  # type: ignore[misc]


def gather_places(
    layout: SceneLayout,
    table: Float[Tensor, "T C"],
    heads: Int[Tensor, "R S"],
    planes: Int[Tensor, "R S"],
    ndc: Float[Tensor, "R S 3"],
    valid: Bool[Tensor, "R S"],
    weights: Float[Tensor, "R S"],
) -> RaySums:
    """See ``reference.gather_places``."""
    lib = build.library()
    (num_rays, slots), channels = weights.shape, table.shape[1]
    held = [x.detach().contiguous() for x in (table, heads, planes, ndc, valid, weights)]
    addresses = [build.address(x, x.dtype) for x in held]
    sums = torch.empty(num_rays, channels + 1 + COLORS)

    def part(begin: int, end: int) -> None:
        lib.mmpi_gather_places(
            CpuScene.of(layout).grids,
            ctypes.c_int64(len(layout.mpis)),
            addresses[0],
            *map(ctypes.c_int64, table.shape),
            *addresses[1:],
            *map(ctypes.c_int64, (begin, end, slots)),
            build.address(sums),
        )

    build.in_parts(part, num_rays)
    return RaySums(*_split(sums, channels))
