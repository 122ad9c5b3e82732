"""Weighted sums of table rows: the gather behind every bilinear and trilinear lookup.

``interpolate_reference`` is plain indexing. ``interpolate`` reads by the embedding-bag kernel (3 to 6 times faster on a
CPU), on a GPU by a Triton kernel, and has a sparse row gradient, so that backward and optimiser cost follow the rows a
batch touched, never the size of the table.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops import native
from mmpi_ns.ops.march import Grid
from mmpi_ns.scene.texels import BRICK, TexelGrid

MOST_ROWS = 2**31
"""The compiled index of rows takes a quarter byte for every row up to the highest: beyond this, torch's sort."""


@dataclass(frozen=True)
class RowIndex:
    """Which rows a list of lookups reads, each once, and which of those every entry is."""

    unique: Int[Tensor, "U"]
    position: Int[Tensor, "..."]
    """Of every entry in ``unique``; int32 or int64."""


def index_rows(rows: Int[Tensor, "..."]) -> RowIndex:
    """The distinct rows of a table that a list names, rising (on a GPU by Triton: in no particular order)."""
    if native.takes_triton(rows):
        from mmpi_ns.ops import triton_tables

        return RowIndex(*triton_tables.index_rows(rows))
    count = rows.numel()
    lib = native.library() if rows.device.type == "cpu" and 0 < count < 2**31 else None
    highest = int(rows.max()) if lib is not None else 0
    if lib is None or highest >= MOST_ROWS:
        unique, position = torch.unique(rows, return_inverse=True)
        return RowIndex(unique, position)
    bricks = torch.zeros(highest // BRICK + 1, 2, dtype=torch.int64)
    unique, position = torch.empty(count, dtype=torch.int64), torch.empty(rows.shape, dtype=torch.int32)
    found = lib.mmpi_index_rows(
        native.address(rows.contiguous(), torch.int64),
        ctypes.c_int64(count),
        native.address(bricks, torch.int64),
        ctypes.c_int64(len(bricks)),
        native.address(unique, torch.int64),
        native.address(position, torch.int32),
    )
    return RowIndex(unique[:found].clone(), position)


def sum_by_position(
    position: Int[Tensor, "N B"], values: Float[Tensor, "N C"], weights: Float[Tensor, "N B"] | None, count: int
) -> Float[Tensor, "U C"]:
    """For each of ``count`` rows the sum of weights[n, b] values[n] over its entries (None: B = 1, weights of 1)."""
    if native.takes_triton(values):
        from mmpi_ns.ops import triton_tables

        return triton_tables.sum_by_position(position, values, weights, count)
    out = torch.zeros(count, values.shape[1], dtype=values.dtype, device=values.device)
    lib = native.library(values) if position.dtype == torch.int32 else None
    if lib is None:
        each = values if weights is None else (values[:, None, :] * weights[..., None]).reshape(-1, values.shape[1])
        return out.index_add_(0, position.reshape(-1), each)
    values, position = values.contiguous(), position.contiguous()
    weights = None if weights is None else weights.contiguous()
    lib.mmpi_scatter_rows(
        native.address(position, torch.int32),
        None if weights is None else native.address(weights),
        native.address(values),
        *map(ctypes.c_int64, (values.shape[0], 1 if weights is None else weights.shape[1], values.shape[1])),
        native.address(out),
    )
    return out


def add_rows(index: RowIndex, values: Float[Tensor, "N C"], weights: Float[Tensor, "N B"] | None) -> Tensor:
    """``sum_by_position`` for each distinct row [U, C]."""
    return sum_by_position(index.position, values, weights, index.unique.shape[0])


def bilinear_rows(
    grid: TexelGrid, planes: Int[Tensor, "N"], ndc: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]]:
    """``TexelGrid.bilinear``, compiled where it can be."""
    lib = native.library(ndc)
    if lib is None:
        return grid.bilinear(planes, ndc)
    planes, ndc = planes.contiguous(), ndc.contiguous()
    rows, weights = torch.empty(len(planes), 4, dtype=torch.int64), torch.empty(len(planes), 4)
    lib.mmpi_bilinear_rows(
        ctypes.byref(Grid.of(grid)),
        native.address(planes, torch.int64),
        native.address(ndc),
        ctypes.c_int64(len(planes)),
        native.address(rows, torch.int64),
        native.address(weights),
    )
    return rows, weights


def interpolate_reference(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """sum_b weights[n, b] table[rows[n, b]], with a dense gradient."""
    return (table[rows] * weights[..., None]).sum(1)


def _weighted_rows(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    if native.takes_triton(table):
        from mmpi_ns.ops import triton_tables

        return triton_tables.interpolate(table, rows, weights)
    return torch.nn.functional.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights)
        ctx.table_shape = table.shape
        return _weighted_rows(table, rows, weights)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, None, None]:
        rows, weights = ctx.saved_tensors
        index = index_rows(rows)
        return _row_gradient(index.unique, add_rows(index, grad_outputs[0], weights), ctx.table_shape), None, None


def interpolate(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``interpolate_reference`` on a fused kernel. The table's gradient is sparse over rows; weights get none.

    Args:
        table: texels, channels last.
        rows: rows to combine for each output.
        weights: their weights (constants).
    """
    return _Interpolate.apply(table, rows, weights.to(table.dtype))  # type: ignore[no-any-return]


def _gathered(table: Tensor, rows: Tensor) -> Tensor:
    lib = native.library(table) if table.ndim == 2 and table.is_contiguous() else None
    if lib is None:
        return table.index_select(0, rows)
    values, rows = torch.empty(len(rows), table.shape[1]), rows.contiguous()

    def gather(begin: int, end: int) -> None:
        lib.mmpi_gather_rows(
            native.address(rows, torch.int64),
            *map(ctypes.c_int64, (begin, end, table.shape[1])),
            *map(native.address, (table, values)),
        )

    native.in_parts(gather, len(rows), least=4096)
    return values


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.table_shape = table.shape
        return _gathered(table, rows)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        return _row_gradient(ctx.saved_tensors[0], grad_outputs[0], ctx.table_shape), None


def gather_rows(table: Float[Tensor, "T C"], rows: Int[Tensor, "U"]) -> Float[Tensor, "U C"]:
    """table[rows] for the distinct rows of ``index_rows``, with a sparse gradient: whatever reads the rows adds its
    gradient densely, over U rows only."""
    return _Gather.apply(table, rows)  # type: ignore[no-any-return]


class _InterpolateGathered(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gathered: Tensor, position: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(position, weights)
        ctx.count = gathered.shape[0]
        return _weighted_rows(gathered, position, weights)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        position, weights = ctx.saved_tensors
        return sum_by_position(position, grad_outputs[0], weights, ctx.count), None, None


def interpolate_gathered(
    gathered: Float[Tensor, "U C"], position: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``interpolate_reference`` on gathered rows, of which ``position`` counts."""
    return _InterpolateGathered.apply(gathered, position, weights.to(gathered.dtype))  # type: ignore[no-any-return]


def _row_gradient(rows: Int[Tensor, "U"], values: Float[Tensor, "U C"], shape: torch.Size) -> Tensor:
    """A sparse gradient of the rows that ``index_rows`` found; where they rise, it is what torch calls coalesced."""
    rises = not native.takes_triton(rows)
    return torch.sparse_coo_tensor(rows[None], values, shape, is_coalesced=rises, check_invariants=False)
