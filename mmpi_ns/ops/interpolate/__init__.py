"""Rows of tables that a batch reads, their weighted sums, and their gradients.

A step reads a few of a table's millions of rows. The cost of backward and optimiser follows those, not the table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor, nn

from mmpi_ns.ops.build import call_in_parts, even_bounds, owned_bounds
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.texels import BRICK

AT_LEAST = 1 << 13
"""Entries, samples or bricks that justify another thread, whose start takes a tenth of a millisecond."""


@dataclass(frozen=True)
class RowIndex:
    """Distinct rows of a list, and the place of every entry among them."""

    unique: Int[Tensor, "U"]
    """Ascending, except for padding."""
    positions: Int[Tensor, "..."]
    """Index of every entry in ``unique``; int32 or int64."""
    count: Int[Tensor, ""] | None = None
    """Number of distinct rows, if a limit was given."""


class Table(nn.Parameter):
    """A parameter of T rows with a gradient of the rows that were read: ``grad`` [U, C] of ``grad_rows`` [U].

    ``read_rows`` adds to the gradient and ``TouchedAdam`` uses it. Elementwise treatment of gradients works as with any
    parameter: dropping, scaling, clipping and norms, in torch and in nerfstudio.
    """

    grad_rows: Int[Tensor, "U"] | None = None
    """Ascending and distinct, but row 0 with a gradient of 0 may follow any number of times."""
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
        """Adds a gradient, in the order of ``grad_rows``, to the present one."""
        if self.grad_rows is not None and self._row_grad is not None:
            rows, values = torch.cat([self.grad_rows, rows]), torch.cat([self._row_grad, values])
            index, ones = index_rows(rows[:, None], len(self), pads=True), torch.ones_like(values[:, :1])
            rows, values = index.unique, sum_rows(index.positions, values, ones, len(index.unique))
        self.grad_rows, self._row_grad = rows, values


@operation("gpu")
def texel_rows(
    layout: SceneLayout,
    heads: Int[Tensor, "N"],
    planes: Int[Tensor, "N"],
    ndc: Float[Tensor, "N 3"],
    count: Int[Tensor, "1"] | None = None,
) -> tuple[Int[Tensor, "N B"], Float[Tensor, "N B"]]:
    """Rows and weights of the texels around samples of several heads, with gradients to ``ndc`` where it requires them:
    four of each sample, or eight where there is a cube (``TexelGrid.trilinear``).

    Args:
        layout: of the scene.
        heads: head of each sample.
        planes: plane of each sample; of those in the cube any number.
        ndc: position of each sample in its head.
        count: samples from this one on read the empty brick; None: none.
    """
    names = ("depth", "height", "width", "down", "across", "first_tile")
    if (sizes := layout.packed.get("sizes")) is None:
        sizes = torch.tensor([[getattr(grid, name) for name in names] for grid in layout.grids], device=heads.device)
        layout.packed["sizes"] = sizes
    of_samples: dict[str, Any] = dict(zip(names, sizes[heads].unbind(-1), strict=True))
    grid = replace(layout.grids[0], **of_samples)
    if layout.cube is None:
        rows, weights = grid.bilinear(planes, ndc)
    else:
        rows, weights = grid.trilinear(ndc, planes.masked_fill(heads == len(layout.mpis), -1))
    if count is not None:
        index = torch.arange(len(rows), device=rows.device)[:, None]
        rows = torch.where(index < count, rows, index % BRICK)
    return rows, weights


@operation()
def index_rows(rows: Int[Tensor, "..."], table_rows: int, pads: bool = False, most: int | None = None) -> RowIndex:
    """Distinct rows of a list, ascending.

    Args:
        rows: the list.
        table_rows: rows of the table.
        pads: row 0, which no entry refers to there, may follow the distinct rows any number of times, which avoids
            synchronisation with a GPU.
        most: limit on the number of distinct rows, padded likewise; entries of further rows refer to the last one.
    """
    listed, order = rows.reshape(-1).sort()
    place = torch.diff(listed, prepend=listed[:1]).ne(0).cumsum(0)
    if most is not None:
        unique = listed.new_zeros(most + 1).index_copy(0, place.clamp(max=most), listed)[:most]
        positions = torch.empty_like(place).index_copy(0, order, place.clamp(max=most - 1))
        return RowIndex(unique, positions.view(rows.shape), place[-1] + 1)
    count = len(listed) if pads or not len(listed) else int(place[-1]) + 1
    unique = torch.zeros_like(listed).index_copy(0, place, listed)[:count]
    return RowIndex(unique, torch.empty_like(place).index_copy(0, order, place).view(rows.shape))


@operation()
def sum_rows(
    positions: Int[Tensor, "N B"], values: Float[Tensor, "N C"], weights: Float[Tensor, "N B"], count: int
) -> Float[Tensor, "U C"]:
    """Sum, for each of ``count`` rows, of weights[n, b] values[n] over the entries of ``positions`` that refer to it.

    On a CPU a row's entries are added in order, for any number of threads. On a GPU sums are atomic, so their last bits
    may differ from run to run.
    """
    out = torch.zeros(count, values.shape[1], dtype=values.dtype, device=values.device)
    each = (values[:, None, :] * weights[..., None]).reshape(-1, values.shape[1])
    return out.index_add_(0, positions.reshape(-1), each)


def read_rows(table: Table, rows: Int[Tensor, "U"]) -> Float[Tensor, "U C"]:
    """table[rows] for the distinct rows of ``index_rows``; their gradient goes to the table's ``grad``."""
    return _ReadRows.apply(table, rows)  # type: ignore[no-any-return]


def weigh_rows(
    values: Float[Tensor, "U C"], positions: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """sum_b weights[n, b] values[positions[n, b]], with dense gradients to values and weights."""
    return _WeighRows.apply(values, positions, weights.to(values.dtype))  # type: ignore[no-any-return]


@operation(in_cpp=AT_LEAST)
def chosen_rows(table: Float[Tensor, "T C"], rows: Int[Tensor, "U"]) -> Float[Tensor, "U C"]:
    """Values of ``read_rows``."""
    return table.index_select(0, rows)


@operation(in_cpp=AT_LEAST)
def weighted_rows(
    table: Float[Tensor, "T C"], rows: Int32[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """Values of ``weigh_rows``."""
    return torch.nn.functional.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def interpolate(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``weigh_rows`` of a table, whose gradient goes to its ``grad`` if it is a ``Table``."""
    if not isinstance(table, Table):
        return weigh_rows(table, rows, weights)
    if not (table.requires_grad and torch.is_grad_enabled()):
        return weigh_rows(table.data, rows, weights)
    index = index_rows(rows, len(table), pads=True)
    return weigh_rows(read_rows(table, index.unique), index.positions, weights)


def interpolate_densely(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """Definition of ``interpolate``, with a dense gradient."""
    return (table[rows] * weights[..., None]).sum(1)


class _ReadRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Table, rows: Tensor) -> Tensor:
        ctx.table, ctx.rows = table, rows
        return chosen_rows(table.data, rows)

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


@texel_rows.on_cpu
def texel_rows_on_cpu(
    layout: SceneLayout, heads: Tensor, planes: Tensor, ndc: Tensor, count: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    if ndc.requires_grad or count is not None:
        return texel_rows.reference(layout, heads, planes, ndc, count)
    taps = 4 if layout.cube is None else 8
    rows, weights = torch.empty(len(heads), taps, dtype=torch.int64), torch.empty(len(heads), taps)
    samples, scene = (x.contiguous() for x in (heads, planes, ndc)), (layout.cpu_grids, len(layout.mpis), taps)
    call_in_parts("mmpi_texel_rows", len(heads), *scene, *samples, rows, weights, least=AT_LEAST)
    return rows, weights


@index_rows.on_cpu
def index_rows_on_cpu(rows: Tensor, table_rows: int, pads: bool = False, most: int | None = None) -> RowIndex:
    count, listed = rows.numel(), rows.long().contiguous()
    words = torch.zeros(-(-table_rows // BRICK), dtype=torch.int64)
    before, positions = torch.empty(len(words), dtype=torch.int32), torch.empty(rows.shape, dtype=torch.int32)
    call_in_parts("mmpi_mark_rows", count, listed, words, least=AT_LEAST)
    bounds = even_bounds(len(words), AT_LEAST)
    counts = torch.empty(len(bounds) - 1, dtype=torch.int64)
    call_in_parts("mmpi_count_rows", bounds, words, counts)
    ends = counts.cumsum(0)
    unique = torch.empty(int(ends[-1]), dtype=torch.int64)
    call_in_parts("mmpi_list_rows", bounds, words, ends - counts, before, unique)
    call_in_parts("mmpi_place_rows", count, listed, words, before, positions, least=AT_LEAST)
    return RowIndex(unique, positions)


@sum_rows.on_cpu
def sum_rows_on_cpu(positions: Tensor, values: Tensor, weights: Tensor, count: int) -> Tensor:
    entries = (x.contiguous() for x in (positions.to(torch.int32), weights, values))
    sums, bounds = torch.empty(count, values.shape[1]), owned_bounds([positions], count, AT_LEAST)
    call_in_parts("mmpi_sum_rows", bounds, *entries, *positions.shape, values.shape[1], sums)
    return sums
