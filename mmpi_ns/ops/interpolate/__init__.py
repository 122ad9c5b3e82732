"""Rows of tables: which of them a batch reads, weighted sums of those, and the gradients of the rows that were read.

A table has millions of rows of which a step reads a few: backward and optimiser follow those, never the table's size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.layout import Places, SceneLayout
from mmpi_ns.scene.texels import BRICK


@dataclass(frozen=True)
class RowIndex:
    """Distinct rows of a list, and the place of every entry among them."""

    unique: Int[Tensor, "U"]
    """Rising, except for padding."""
    positions: Int[Tensor, "..."]
    """Of every entry in ``unique``; int32 or int64."""


class HeadSamples(NamedTuple):
    """The valid samples of a batch: heads rising, and the slots of each head."""

    slots: Int[Tensor, "N"]
    """Flat slots [R, S] of the samples."""
    heads: Int[Tensor, "N"]
    planes: Int[Tensor, "N"]
    ndc: Float[Tensor, "N 3"]
    counts: Sequence[int]
    """Samples of each head."""


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


@operation("cpu")
def order_by_head(places: Places, num_heads: int, counts: Sequence[int] | None = None) -> HeadSamples:
    """Valid samples of a batch, ordered by head and otherwise by slot.

    Args:
        places: of the samples.
        num_heads: of the scene.
        counts: samples of each head, if known; otherwise this synchronises with a GPU.
    """
    heads, valid = places.heads.reshape(-1), places.valid.reshape(-1)
    if counts is None:
        parts = [(valid & (heads == k)).nonzero()[:, 0] for k in range(num_heads)]
        slots, counts = torch.cat(parts), [len(p) for p in parts]
    else:
        keys = torch.where(valid, heads, num_heads)
        slots = torch.sort(keys.to(torch.int16), stable=True).indices[: sum(counts)]
    planes, ndc = places.planes.reshape(-1)[slots], places.ndc.reshape(-1, 3)[slots]
    return HeadSamples(slots, heads[slots], planes, ndc, counts)


@operation("cpu", "gpu")
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
    rows, weights = planes.new_zeros(len(heads), 4), ndc.new_zeros(len(heads), 4)
    for k, grid in enumerate(layout.grids[: len(layout.mpis)]):
        here = (heads == k).nonzero()[:, 0]
        rows[here], weights[here] = grid.bilinear(planes[here], ndc[here])
    return rows, weights


@operation("cpu", "gpu")
def index_rows(rows: Int[Tensor, "..."], table_rows: int, pads: bool = False) -> RowIndex:
    """Distinct rows of a list, rising.

    Args:
        rows: the list.
        table_rows: rows of the table.
        pads: row 0, which no entry refers to there, may follow the distinct rows any number of times. A GPU then
            need not be waited for to tell their number.
    """
    return RowIndex(*torch.unique(rows, return_inverse=True))


@operation("cpu", "gpu")
def sum_rows(
    positions: Int[Tensor, "N B"], values: Float[Tensor, "N C"], weights: Float[Tensor, "N B"], count: int
) -> Float[Tensor, "U C"]:
    """For each of ``count`` rows the sum of weights[n, b] values[n] over the entries of ``positions`` that refer to it.

    On a CPU a row's entries are added in order, for any number of threads. On a GPU sums are atomic, so their last bits
    may differ from run to run.
    """
    out = torch.zeros(count, values.shape[1], dtype=values.dtype, device=values.device)
    each = (values[:, None, :] * weights[..., None]).reshape(-1, values.shape[1])
    return out.index_add_(0, positions.reshape(-1), each)


@operation("cpu")
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
    bricks = (rows // BRICK)[positions.reshape(-1)]
    peaks.scatter_reduce_(0, bricks, weights.repeat_interleave(positions.shape[1]), "amax")


def read_rows(table: Table, rows: Int[Tensor, "U"]) -> Float[Tensor, "U C"]:
    """table[rows] for the distinct rows of ``index_rows``; their gradient goes to the table's ``grad``."""
    return _ReadRows.apply(table, rows)  # type: ignore[no-any-return]


def weigh_rows(
    values: Float[Tensor, "U C"], positions: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """sum_b weights[n, b] values[positions[n, b]], with dense gradients to values and weights."""
    return _WeighRows.apply(values, positions, weights.to(values.dtype))  # type: ignore[no-any-return]


@operation("gpu")
def weighted_rows(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """Values of ``weigh_rows``."""
    return torch.nn.functional.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def interpolate(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``weigh_rows`` of a table, whose gradient goes to its ``grad`` if it is a ``Table``."""
    if not (isinstance(table, Table) and table.requires_grad and torch.is_grad_enabled()):
        return weigh_rows(table, rows, weights)
    index = index_rows(rows, len(table), pads=True)
    return weigh_rows(read_rows(table, index.unique), index.positions, weights)


def interpolate_densely(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``interpolate`` as it is defined, with a dense gradient."""
    return (table[rows] * weights[..., None]).sum(1)


class _ReadRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Table, rows: Tensor) -> Tensor:
        ctx.table, ctx.rows = table, rows
        return table.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[None, None]:
        ctx.table.add_grad(ctx.rows, grad_outputs[0])
        return None, None


class _WeighRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, positions: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(positions, weights, values if ctx.needs_input_grad[2] else None)
        ctx.count = len(values)
        return weighted_rows(values, positions, weights)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, None, Tensor | None]:
        (positions, weights, values), grad = ctx.saved_tensors, grad_outputs[0]
        to_values = sum_rows(positions, grad, weights, ctx.count) if ctx.needs_input_grad[0] else None
        to_weights = None if values is None else (values[positions] * grad[:, None]).sum(-1)
        return to_values, None, to_weights
