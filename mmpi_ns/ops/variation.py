"""Total variation of chosen texels, with its gradient in the same pass."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops import native
from mmpi_ns.ops.march import Grid
from mmpi_ns.scene.texels import TexelGrid

Scales = list[tuple[float, float, float]]
PART = 4096
"""Texels whose differences the compiled kernel sums together, so that a sum does not depend on the threads."""


def clamped_differences(
    values: Float[Tensor, "N C"], neighbours: Float[Tensor, "N M C"], scales: Float[Tensor, "N M"]
) -> Float[Tensor, ""]:
    """Total variation of texels with given neighbours: clamped differences, whose gradient is DVGO's (L_TV).

    DVGO adds ``scale / 6 * clamp(v - v_neighbour, -1, 1)`` to the gradient of each touched texel. That is the gradient
    of a Huber function of the difference with the neighbour held fixed, so it is an ordinary loss here.

    Args:
        values: texels that the batch touched, one row each.
        neighbours: their neighbours along each axis (held fixed).
        scales: weight of each difference (resolution / 128, 0 where there is no neighbour).
    """
    difference = values[:, None, :] - neighbours.detach()
    size = difference.abs()
    huber = torch.where(size <= 1, 0.5 * difference**2, size - 0.5)
    return (scales[..., None] * huber).sum() / 6


def total_variation_reference(
    values: Float[Tensor, "U C"],
    table: Float[Tensor, "T C"],
    rows: Int[Tensor, "U"],
    grids: list[TexelGrid],
    scales: Scales,
) -> Float[Tensor, ""]:
    """``clamped_differences`` of distinct texels with their neighbours of the same head.

    Args:
        values: the texels, gathered from the table.
        table: the pooled table (held fixed).
        rows: where they came from.
        grids: texels of all heads.
        scales: weight of a difference along x, y and z, of each head.
    """
    total = values.new_zeros(())
    for grid, each in zip(grids, scales, strict=True):
        own = grid.holds(rows).nonzero()[:, 0]
        neighbours, exists = grid.neighbours(rows[own])
        weights = exists * torch.tensor([s for s in each for _ in range(2)], device=rows.device)
        around = table[neighbours.reshape(-1)].view(*neighbours.shape, -1)
        total = total + clamped_differences(values[own], around, weights)
    return total


@functools.lru_cache(maxsize=8)
def _on_device(grids: tuple[TexelGrid, ...], scales: tuple[tuple[float, ...], ...], device: torch.device):
    """Layout and scales as tensors, copied to the device once."""
    from mmpi_ns.ops.triton_scene import layout_of

    return layout_of(list(grids), [0] * len(grids), device), torch.tensor(scales, dtype=torch.float32, device=device)


class _Variation(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        values: Tensor,
        lib: ctypes.CDLL,
        table: Tensor,
        rows: Tensor,
        grids: list[TexelGrid],
        scales: Scales,
    ) -> Tensor:
        gradient = torch.empty_like(values)
        blocks = (Grid * len(grids))(*(Grid.of(g) for g in grids))
        flat = [s for each in scales for s in each]
        totals = torch.zeros(-(-len(rows) // PART), dtype=torch.float64)

        def vary(begin: int, end: int) -> None:
            lib.mmpi_total_variation(
                native.address(rows, torch.int64),
                *map(ctypes.c_int64, (len(rows), begin, end, table.shape[1])),
                native.address(table),
                ctypes.c_int64(len(table)),
                blocks,
                ctypes.c_int64(len(grids)),
                native.address(grids[0].places, torch.int64),
                (ctypes.c_float * len(flat))(*flat),
                native.address(gradient),
                native.address(totals, torch.float64),
            )

        native.in_parts(vary, len(totals), least=1)
        ctx.save_for_backward(gradient)
        return totals.sum().to(values.dtype)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.saved_tensors[0] * grad_outputs[0], None, None, None, None, None


def total_variation(
    values: Float[Tensor, "U C"],
    table: Float[Tensor, "T C"],
    rows: Int[Tensor, "U"],
    grids: list[TexelGrid],
    scales: Scales,
) -> Float[Tensor, ""]:
    """``total_variation_reference``, compiled where it can be."""
    if native.takes_triton(table):
        from mmpi_ns.ops.triton_tables import Variation

        return Variation.apply(values, table, rows, *_on_device(tuple(grids), tuple(scales), rows.device))  # type: ignore
    lib = native.library(table)
    if lib is None:
        return total_variation_reference(values, table, rows, grids, scales)
    return _Variation.apply(values, lib, table, rows.contiguous(), grids, scales)  # type: ignore[no-any-return]
