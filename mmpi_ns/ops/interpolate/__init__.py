"""Rows of tables: which of them a batch reads, weighted sums of those, and the gradients of the rows that were read.

A table has millions of rows of which a step reads a few: backward and optimiser follow those, never the table's size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.interpolate import reference
from mmpi_ns.ops.interpolate.reference import HeadSamples, RowIndex
from mmpi_ns.ops.layout import Places, SceneLayout
from mmpi_ns.ops.shapes import check_shapes

__all__ = ["HeadSamples", "RowIndex", "Table", "index_rows", "interpolate", "order_by_head", "raise_peaks", "read_rows",
           "sum_rows", "texel_rows", "weigh_rows"]  # fmt: skip


class Table(nn.Parameter):
    """A parameter of T rows, whose gradient is that of the rows that were read: ``grad`` [U, C] of ``grad_rows`` [U].

    ``read_rows`` brings the gradient and ``TouchedAdam`` takes it. Whatever treats gradients number by number works as
    with any parameter: dropping, scaling, clipping and norms, in torch and in nerfstudio.
    """

    grad_rows: Int[Tensor, "U"] | None = None
    """Rising and each once, but that row 0 with a gradient of 0 may follow any number of times."""
    _row_grad: Float[Tensor, "U C"] | None = None

    @property
    def grad(self) -> Float[Tensor, "U C"] | None:  # type: ignore[override]
        """Gradient of ``grad_rows``; None if no row was read since it was dropped."""
        assert super().grad is None, "what reads a table must do so by read_rows, or it learns nothing"
        return self._row_grad

    @grad.setter
    def grad(self, value: None) -> None:
        assert value is None, "a table's gradient comes with its rows: add_grad"
        self.grad_rows = self._row_grad = None

    def add_grad(self, rows: Int[Tensor, "U"], values: Float[Tensor, "U C"]) -> None:
        """Adds the gradient of rows in the order of ``grad_rows`` to what is there."""
        if self.grad_rows is not None and self._row_grad is not None:
            rows, values = torch.cat([self.grad_rows, rows]), torch.cat([self._row_grad, values])
            index, ones = index_rows(rows[:, None], len(self), pads=True), torch.ones_like(values[:, :1])
            rows, values = index.unique, sum_rows(index.positions, values, ones, len(index.unique))
        self.grad_rows, self._row_grad = rows, values

    def dense_grad(self) -> Float[Tensor, "T C"] | None:
        """The gradient of all rows; to look at, not to train with."""
        if self.grad_rows is None or self._row_grad is None:
            return None
        return torch.zeros_like(self.data).index_add_(0, self.grad_rows, self._row_grad)


def order_by_head(places: Places, num_heads: int, counts: Sequence[int] | None = None) -> HeadSamples:
    """Valid samples of a batch, ordered by head and otherwise by slot.

    Args:
        places: of the samples.
        num_heads: of the scene.
        counts: samples of each head, if known; otherwise this synchronises with a GPU.
    """
    check_shapes("heads R S, planes R S, ndc R S 3, valid R S", *places)
    return dispatch.run("order_by_head", places, num_heads, counts)


def texel_rows(
    layout: SceneLayout, heads: Int[Tensor, "N"], planes: Int[Tensor, "N"], ndc: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]]:
    """Rows and weights of the four texels around samples of several MPIs (``TexelGrid.bilinear``), with gradients to
    ``ndc`` where it requires them.

    Args:
        layout: of the scene.
        heads: MPI of each sample.
        planes: plane of each sample.
        ndc: position of each sample in its MPI.
    """
    check_shapes("heads N, planes N, ndc N 3", heads, planes, ndc)
    if ndc.requires_grad:
        return reference.texel_rows(layout, heads, planes, ndc)
    return dispatch.run("texel_rows", layout, heads, planes, ndc)


def index_rows(rows: Int[Tensor, "..."], table_rows: int, pads: bool = False) -> RowIndex:
    """Distinct rows of a list, rising.

    Args:
        rows: the list.
        table_rows: rows of the table.
        pads: row 0, which no entry refers to there, may follow the distinct rows any number of times. A GPU then
            need not be waited for to tell their number.
    """
    return dispatch.run("index_rows", rows, table_rows, pads)


def sum_rows(
    positions: Int[Tensor, "N B"], values: Float[Tensor, "N C"], weights: Float[Tensor, "N B"], count: int
) -> Float[Tensor, "U C"]:
    """For each of ``count`` rows the sum of weights[n, b] values[n] over the entries of ``positions`` that refer to it.

    On a CPU a row's entries are added in order, for any number of threads. On a GPU sums are atomic, so their last bits
    may differ from run to run.
    """
    check_shapes("positions N B, values N C, weights N B", positions, values, weights)
    return dispatch.run("sum_rows", positions, values, weights, count)


def raise_peaks(
    peaks: Float[Tensor, "K"], rows: Int[Tensor, "U"], positions: Int[Tensor, "N B"], weights: Float[Tensor, "N"]
) -> None:
    """Raises each brick's peak to the largest weight of the samples that read its rows, in place.

    Args:
        peaks: of all bricks.
        rows: distinct rows.
        positions: of the rows that each sample reads, among those.
        weights: of the samples.
    """
    check_shapes("peaks K, rows U, positions N B, weights N", peaks, rows, positions, weights)
    dispatch.run("raise_peaks", peaks, rows, positions, weights)


def read_rows(table: Table, rows: Int[Tensor, "U"]) -> Float[Tensor, "U C"]:
    """table[rows] for the distinct rows of ``index_rows``; their gradient goes to the table's ``grad``."""
    check_shapes("table T C, rows U", table, rows)
    return _ReadRows.apply(table, rows)  # type: ignore[no-any-return]


def weigh_rows(
    values: Float[Tensor, "U C"], positions: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """sum_b weights[n, b] values[positions[n, b]], with dense gradients to values and weights."""
    check_shapes("values U C, positions N B, weights N B", values, positions, weights)
    return _WeighRows.apply(values, positions, weights.to(values.dtype))  # type: ignore[no-any-return]


def interpolate(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``weigh_rows`` of a table, whose gradient goes to its ``grad`` if it is a ``Table``."""
    if not (isinstance(table, Table) and table.requires_grad and torch.is_grad_enabled()):
        return weigh_rows(table, rows, weights)
    index = index_rows(rows, len(table), pads=True)
    return weigh_rows(read_rows(table, index.unique), index.positions, weights)


class _ReadRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Table, rows: Tensor) -> Tensor:
        ctx.table, ctx.rows = table, rows
        return dispatch.run("take_rows", table, rows)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[None, None]:
        ctx.table.add_grad(ctx.rows, grad_outputs[0])
        return None, None


class _WeighRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, positions: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(positions, weights, values if ctx.needs_input_grad[2] else None)
        ctx.count = len(values)
        return dispatch.run("weighted_rows", values, positions, weights)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, None, Tensor | None]:
        (positions, weights, values), grad = ctx.saved_tensors, grad_outputs[0]
        to_values = sum_rows(positions, grad, weights, ctx.count) if ctx.needs_input_grad[0] else None
        to_weights = None if values is None else (values[positions] * grad[:, None]).sum(-1)
        return to_values, None, to_weights
