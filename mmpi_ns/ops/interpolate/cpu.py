"""Rows of tables, compiled: ``interpolate.cpp``."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops.build import address, addresses, in_parts, library, sizes
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.interpolate import reference
from mmpi_ns.ops.interpolate.reference import RowIndex
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.texels import BRICK

MOST_ROWS = 2**31
"""A quarter byte is taken for every row of the table: beyond this, torch's sort."""


def texel_rows(layout: SceneLayout, heads: Tensor, planes: Tensor, ndc: Tensor) -> tuple[Tensor, Tensor]:
    """See ``ops.interpolate``."""
    held = [x.contiguous() for x in (heads, planes, ndc)]
    rows, weights = torch.empty(len(heads), 4, dtype=torch.int64), torch.empty(len(heads), 4)
    grids = CpuScene.of(layout).grids
    library().mmpi_texel_rows(grids, *addresses(held), *sizes(len(heads)), *addresses((rows, weights)))
    return rows, weights


def index_rows(rows: Tensor, table_rows: int, pads: bool) -> RowIndex:
    """See ``ops.interpolate``."""
    count = rows.numel()
    if table_rows > MOST_ROWS or not 0 < count < 2**31:
        return reference.index_rows(rows, table_rows, pads)
    bricks = torch.zeros(-(-table_rows // BRICK), 2, dtype=torch.int64)
    unique, position = torch.empty(count, dtype=torch.int64), torch.empty(rows.shape, dtype=torch.int32)
    given = (address(rows.contiguous(), torch.int64), *sizes(count), address(bricks, torch.int64), *sizes(len(bricks)))
    found = library().mmpi_index_rows(*given, *addresses((unique, position)))
    return RowIndex(unique[:found].clone(), position)


def sum_rows(position: Tensor, values: Tensor, weights: Tensor | None, count: int) -> Tensor:
    """See ``ops.interpolate``."""
    if position.dtype != torch.int32:
        return reference.sum_rows(position, values, weights, count)
    out, taps = torch.zeros(count, values.shape[1]), 1 if weights is None else weights.shape[1]
    position, values = position.contiguous(), values.contiguous()
    weights = None if weights is None else weights.contiguous()
    given = (address(position, torch.int32), None if weights is None else address(weights), address(values))
    library().mmpi_sum_rows(*given, *sizes(values.shape[0], taps, values.shape[1]), address(out))
    return out


def raise_peaks(peaks: Tensor, rows: Tensor, weights: Tensor) -> None:
    """See ``ops.interpolate``."""
    rows, weights = rows.contiguous(), weights.contiguous()
    given = (address(rows, torch.int64), *addresses((weights,)), *sizes(*rows.shape))
    library().mmpi_raise_peaks(*given, address(peaks))


def take_rows(table: Tensor, rows: Tensor) -> Tensor:
    """See ``ops.interpolate.reference``."""
    if table.ndim != 2 or not table.is_contiguous():
        return reference.take_rows(table, rows)
    values, rows, lib = torch.empty(len(rows), table.shape[1]), rows.contiguous(), library()
    given, made = address(rows, torch.int64), addresses((table, values))
    in_parts(lambda a, b: lib.mmpi_take_rows(given, *sizes(a, b, table.shape[1]), *made), len(rows), least=4096)
    return values
