"""Rows of tables, compiled: ``interpolate.cpp``."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops.build import call, call_in_parts
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.interpolate import reference
from mmpi_ns.ops.interpolate.reference import RowIndex
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.texels import BRICK

MOST_ROWS = 2**31
"""A quarter byte is taken for every row of the table: beyond this, torch's sort."""


def texel_rows(layout: SceneLayout, heads: Tensor, planes: Tensor, ndc: Tensor) -> tuple[Tensor, Tensor]:
    """See ``ops.interpolate``."""
    rows, weights = torch.empty(len(heads), 4, dtype=torch.int64), torch.empty(len(heads), 4)
    given = (x.contiguous() for x in (heads, planes, ndc))
    call("mmpi_texel_rows", CpuScene.of(layout).grids, *given, len(heads), rows, weights)
    return rows, weights


def index_rows(rows: Tensor, table_rows: int, pads: bool) -> RowIndex:
    """See ``ops.interpolate``."""
    count = rows.numel()
    if table_rows > MOST_ROWS or not 0 < count < 2**31:
        return reference.index_rows(rows, table_rows, pads)
    bricks = torch.zeros(-(-table_rows // BRICK), 2, dtype=torch.int64)
    unique, position = torch.empty(count, dtype=torch.int64), torch.empty(rows.shape, dtype=torch.int32)
    found = call("mmpi_index_rows", rows.long().contiguous(), count, bricks, len(bricks), unique, position)
    return RowIndex(unique[:found].clone(), position)


def sum_rows(position: Tensor, values: Tensor, weights: Tensor | None, count: int) -> Tensor:
    """See ``ops.interpolate``."""
    if position.dtype != torch.int32:
        return reference.sum_rows(position, values, weights, count)
    out, taps = torch.zeros(count, values.shape[1]), 1 if weights is None else weights.shape[1]
    given = (None if x is None else x.contiguous() for x in (position, weights, values))
    call("mmpi_sum_rows", *given, len(values), taps, values.shape[1], out)
    return out


def raise_peaks(peaks: Tensor, rows: Tensor, weights: Tensor) -> None:
    """See ``ops.interpolate``."""
    call("mmpi_raise_peaks", rows.contiguous(), weights.contiguous(), *rows.shape, peaks)


def take_rows(table: Tensor, rows: Tensor) -> Tensor:
    """See ``ops.interpolate.reference``."""
    if table.ndim != 2 or not table.is_contiguous():
        return reference.take_rows(table, rows)
    values = torch.empty(len(rows), table.shape[1])
    call_in_parts("mmpi_take_rows", len(rows), (rows.contiguous(),), (table.shape[1], table, values), least=4096)
    return values
