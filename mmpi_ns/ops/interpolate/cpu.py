"""Rows of tables, compiled: ``interpolate.cpp``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mmpi_ns.ops import interpolate
from mmpi_ns.ops.build import call_in_parts, even_bounds, owned_bounds, run_in_parts
from mmpi_ns.ops.cpu_scene import grids_of
from mmpi_ns.ops.interpolate import HeadSamples, RowIndex
from mmpi_ns.ops.layout import Places, SceneLayout
from mmpi_ns.scene.texels import BRICK

MOST_ROWS = 2**31
"""A bit is taken for every row of the table: beyond this, torch's sort."""
AT_LEAST = 1 << 15
"""Entries, samples or bricks that are worth another thread, whose start takes as long as a tenth of a millisecond."""


def order_by_head(places: Places, num_heads: int, counts: Sequence[int] | None) -> HeadSamples:
    heads, planes, ndc, valid = (x.contiguous() for x in places)
    bounds = even_bounds(heads.numel(), AT_LEAST)
    in_parts = torch.zeros(len(bounds) - 1, num_heads, dtype=torch.int64)
    run_in_parts("mmpi_count_heads", bounds, heads, valid, num_heads, in_parts)
    totals = in_parts.sum(0)
    starts = totals.cumsum(0) - totals + in_parts.cumsum(0) - in_parts
    count = int(totals.sum())
    slots, of_heads, of_planes = torch.empty(3, count, dtype=torch.int64)
    columns = (slots, of_heads, of_planes, torch.empty(count, 3))
    run_in_parts("mmpi_order_by_head", bounds, heads, planes, ndc, valid, num_heads, starts, *columns)
    return HeadSamples(*columns, totals.tolist())


def texel_rows(layout: SceneLayout, heads: Tensor, planes: Tensor, ndc: Tensor) -> tuple[Tensor, Tensor]:
    if ndc.requires_grad:
        return interpolate.texel_rows.reference(layout, heads, planes, ndc)
    rows, weights = torch.empty(len(heads), 4, dtype=torch.int64), torch.empty(len(heads), 4)
    samples = (x.contiguous() for x in (heads, planes, ndc))
    call_in_parts("mmpi_texel_rows", len(heads), grids_of(layout), *samples, rows, weights, least=AT_LEAST)
    return rows, weights


def index_rows(rows: Tensor, table_rows: int, pads: bool) -> RowIndex:
    count, listed = rows.numel(), rows.long().contiguous()
    if table_rows > MOST_ROWS or not 0 < count < 2**31:
        return interpolate.index_rows.reference(rows, table_rows, pads)
    words = torch.zeros(-(-table_rows // BRICK), dtype=torch.int64)
    before, positions = torch.empty(len(words), dtype=torch.int32), torch.empty(rows.shape, dtype=torch.int32)
    call_in_parts("mmpi_mark_rows", count, listed, words, least=AT_LEAST)
    bounds = even_bounds(len(words), AT_LEAST)
    counts = torch.empty(len(bounds) - 1, dtype=torch.int64)
    run_in_parts("mmpi_count_rows", bounds, words, counts)
    ends = counts.cumsum(0)
    unique = torch.empty(int(ends[-1]), dtype=torch.int64)
    run_in_parts("mmpi_list_rows", bounds, words, ends - counts, before, unique)
    call_in_parts("mmpi_place_rows", count, listed, words, before, positions, least=AT_LEAST)
    return RowIndex(unique, positions)


def sum_rows(positions: Tensor, values: Tensor, weights: Tensor, count: int) -> Tensor:
    if positions.dtype != torch.int32:
        return interpolate.sum_rows.reference(positions, values, weights, count)
    sums, entries = torch.empty(count, values.shape[1]), (x.contiguous() for x in (positions, weights, values))
    bounds = owned_bounds([positions], count, AT_LEAST)
    run_in_parts("mmpi_sum_rows", bounds, *entries, *positions.shape, values.shape[1], sums)
    return sums


def raise_peaks(peaks: Tensor, rows: Tensor, positions: Tensor, weights: Tensor) -> None:
    if positions.dtype != torch.int32:
        return interpolate.raise_peaks.reference(peaks, rows, positions, weights)
    samples = (positions.contiguous(), weights.contiguous(), positions.shape[1])
    call_in_parts("mmpi_raise_peaks", len(positions), *samples, rows.contiguous(), peaks, least=AT_LEAST)
