"""Weighted sums of table rows: the gather behind every bilinear and trilinear lookup.

The table's gradient is sparse over its rows, so that backward and optimiser cost follow the rows a batch touched, never
the size of the table.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.interpolate import reference
from mmpi_ns.ops.interpolate.reference import RowIndex
from mmpi_ns.ops.layout import SceneLayout


def texel_rows(
    layout: SceneLayout, heads: Int[Tensor, "N"], planes: Int[Tensor, "N"], ndc: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]]:
    """``TexelGrid.bilinear`` of samples in several MPIs: the rows that each reads, and their weights, with gradients to
    ``ndc`` where it wants them."""
    if ndc.requires_grad:
        return reference.texel_rows(layout, heads, planes, ndc)
    return dispatch.run("texel_rows", layout, heads, planes, ndc)


def index_rows(rows: Int[Tensor, "..."], table_rows: int, pads: bool = False) -> RowIndex:
    """The distinct rows, rising, that a list names of a table of so many.

    Args:
        rows: the list.
        table_rows: of the table.
        pads: the distinct rows may be followed by row 0 over and over, which no entry is: a GPU then need not be waited
            for to tell their number.
    """
    return dispatch.run("index_rows", rows, table_rows, pads)


def sum_rows(
    position: Int[Tensor, "N B"], values: Float[Tensor, "N C"], weights: Float[Tensor, "N B"] | None, count: int
) -> Float[Tensor, "U C"]:
    """For each of ``count`` rows the sum of weights[n, b] values[n] over its entries (None: B = 1, weights of 1).

    On a GPU sums are atomic, so their last bits may differ from run to run.
    """
    return dispatch.run("sum_rows", position, values, weights, count)


def raise_peaks(peaks: Float[Tensor, "B"], rows: Int[Tensor, "N T"], weights: Float[Tensor, "N"]) -> None:
    """Raises each brick's peak to the largest weight of the samples that read rows of it, in place."""
    dispatch.run("raise_peaks", peaks, rows, weights)


def interpolate(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """sum_b weights[n, b] table[rows[n, b]]. The table's gradient is sparse over rows.

    Args:
        table: texels, channels last.
        rows: rows to combine for each output.
        weights: their weights.
    """
    return _Interpolate.apply(table, rows, weights.to(table.dtype))  # type: ignore[no-any-return]


def gather_rows(table: Float[Tensor, "T C"], rows: Int[Tensor, "U"]) -> Float[Tensor, "U C"]:
    """table[rows] for the distinct rows of ``index_rows``, with a sparse gradient: whatever reads the rows adds its
    gradient densely, over U rows only."""
    return _Gather.apply(table, rows)  # type: ignore[no-any-return]


def interpolate_gathered(
    gathered: Float[Tensor, "U C"], position: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``interpolate`` on gathered rows, of which ``position`` counts; with a dense gradient."""
    return _InterpolateGathered.apply(gathered, position, weights.to(gathered.dtype))  # type: ignore[no-any-return]


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights, _if_moved(ctx, table))
        ctx.table_shape = table.shape
        return dispatch.run("weighted_rows", table, rows, weights)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, None, Tensor | None]:
        rows, weights, table = ctx.saved_tensors
        to_table = None
        if ctx.needs_input_grad[0]:
            index = index_rows(rows, ctx.table_shape[0], pads=True)
            values = sum_rows(index.position, grad_outputs[0], weights, len(index.unique))
            to_table = _row_gradient(index.unique, values, ctx.table_shape)
        return to_table, None, _weight_gradient(table, rows, grad_outputs[0])


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.table_shape = table.shape
        return dispatch.run("take_rows", table, rows)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        return _row_gradient(ctx.saved_tensors[0], grad_outputs[0], ctx.table_shape), None


class _InterpolateGathered(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gathered: Tensor, position: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(position, weights, _if_moved(ctx, gathered))
        ctx.count = gathered.shape[0]
        return dispatch.run("weighted_rows", gathered, position, weights)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, Tensor | None]:
        position, weights, gathered = ctx.saved_tensors
        to_weights = _weight_gradient(gathered, position, grad_outputs[0])
        return sum_rows(position, grad_outputs[0], weights, ctx.count), None, to_weights


def _if_moved(ctx: Any, table: Tensor) -> Tensor | None:
    """The table, where the gradient of the weights is wanted: samples may be moved."""
    return table if ctx.needs_input_grad[2] else None


def _weight_gradient(table: Tensor | None, rows: Tensor, grad: Tensor) -> Float[Tensor, "N B"] | None:
    """What each row holds, along the gradient of the sum that it is weighed into."""
    return None if table is None else (table[rows] * grad[:, None]).sum(-1)


def _row_gradient(rows: Int[Tensor, "U"], values: Float[Tensor, "U C"], shape: torch.Size) -> Tensor:
    """A sparse gradient of the rows that ``index_rows`` found: rising, so what torch calls coalesced."""
    return torch.sparse_coo_tensor(rows[None], values, shape, is_coalesced=True, check_invariants=False)
