"""Rows of tables on a GPU: which a batch reads, what is there, and sums over the entries of each (atomic)."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops import interpolate
from mmpi_ns.ops.gpu_scene import HEIGHT, INTS, WIDTH, block_size, cell, grids_of, launch, read_taps, row_of
from mmpi_ns.ops.interpolate import RowIndex
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.texels import BRICK

ROWS = 128
"""Samples, or rows, of a program."""


# Which rows ---------------------------------------------------------------------------------------------------------


@triton.jit(do_not_specialize=("count",))
def texel_rows_kernel(heads, planes, ndc, grids, rows, weights, count, BLOCK: tl.constexpr):
    """Rows and weights of the four texels around samples."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    head, plane = tl.load(heads + i, inside, 0), tl.load(planes + i, inside, 0)
    grid = grids + head * INTS
    x, fx = cell(tl.load(ndc + 3 * i, inside, 0.0), tl.load(grid + WIDTH))
    y, fy = cell(tl.load(ndc + 3 * i + 1, inside, 0.0), tl.load(grid + HEIGHT))
    for tap in tl.static_range(4):
        dx, dy = tap % 2, tap // 2
        weight = (fx if dx else 1 - fx) * (fy if dy else 1 - fy)
        tl.store(rows + i * 4 + tap, row_of(grids, head, plane, y + dy, x + dx, inside), inside)
        tl.store(weights + i * 4 + tap, weight, inside)


def texel_rows(layout: SceneLayout, heads: Tensor, planes: Tensor, ndc: Tensor) -> tuple[Tensor, Tensor]:
    if ndc.requires_grad:
        return interpolate.texel_rows.reference(layout, heads, planes, ndc)
    count, grids = len(heads), grids_of(layout)
    rows = torch.empty(count, 4, dtype=torch.int64, device=ndc.device)
    weights = torch.empty(count, 4, device=ndc.device)
    tensors, block = (x.contiguous() for x in (heads, planes, ndc)), block_size(ROWS, ndc.device)
    launch(texel_rows_kernel, count, block, *tensors, grids, rows, weights, count, BLOCK=block)
    return rows, weights


# Interpolation ------------------------------------------------------------------------------------------------------


@triton.jit(do_not_specialize=("count",))
def weighted_rows_kernel(
    table, rows, weights, out, count, channels, TAPS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    """out[n] = sum_b weights[n, b] table[rows[n, b]]."""
    i, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)[None, :]
    inside = i < count
    total = read_taps(table, rows, weights, i, inside, channels, column, TAPS)
    tl.store(out + i[:, None] * channels + column, total, inside[:, None] & (column < channels))


def weighted_rows(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    count, channels = len(rows), table.shape[1]
    out = torch.empty(count, channels, device=table.device)
    block, columns = block_size(ROWS, table.device), triton.next_power_of_2(channels)
    tensors = (table, rows.contiguous(), weights.contiguous(), out)
    launch(
        weighted_rows_kernel, count, block, *tensors, count, channels, TAPS=rows.shape[1], CHANNELS=columns, BLOCK=block
    )
    return out


@triton.jit(do_not_specialize=("count",))
def sum_rows_kernel(
    positions, weights, values, sums, count, channels, TAPS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    """sums[positions[n, b]] += weights[n, b] values[n]."""
    i, c = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)
    inside = i < count
    both = inside[:, None] & (c < channels)[None, :]
    value = tl.load(values + i[:, None] * channels + c[None, :], both, 0.0)
    for tap in tl.static_range(TAPS):
        row = tl.load(positions + i * TAPS + tap, inside, 0).to(tl.int64)
        part = tl.load(weights + i * TAPS + tap, inside, 0.0)[:, None] * value
        tl.atomic_add(sums + row[:, None] * channels + c[None, :], part, both, sem="relaxed")


def sum_rows(positions: Tensor, values: Tensor, weights: Tensor, count: int) -> Tensor:
    (samples, channels), block = values.shape, block_size(ROWS, values.device)
    sums = torch.zeros(count, channels, device=values.device)
    tensors, columns = (x.contiguous() for x in (positions, weights, values)), triton.next_power_of_2(channels)
    sizes = {"TAPS": weights.shape[1], "CHANNELS": columns, "BLOCK": block}
    launch(sum_rows_kernel, samples, block, *tensors, sums, samples, channels, **sizes)
    return sums


# Distinct rows ------------------------------------------------------------------------------------------------------


@triton.jit(do_not_specialize=("count",))
def mark_kernel(rows, words, count, BLOCK: tl.constexpr):
    """Sets the bit of every row in words of 32."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = tl.load(rows + i, i < count, 0)
    tl.atomic_or(words + (row >> 5), 1 << (row & 31).to(tl.int32), i < count, sem="relaxed")


@triton.jit
def _bits(word):
    """How many bits of a 32-bit word are set."""
    word = word - ((word >> 1) & 0x55555555)
    word = (word & 0x33333333) + ((word >> 2) & 0x33333333)
    return ((((word + (word >> 4)) & 0x0F0F0F0F) * 0x01010101) >> 24) & 0xFF


@triton.jit(do_not_specialize=("size",))
def count_kernel(words, counts, size, BLOCK: tl.constexpr):
    """counts[i] = set bits of the two words of brick i."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    first, second = tl.load(words + 2 * i, i < size, 0), tl.load(words + 2 * i + 1, i < size, 0)
    tl.store(counts + i, _bits(first) + _bits(second), i < size)


@triton.jit(do_not_specialize=("size",))
def list_kernel(words, ends, unique, size, BLOCK: tl.constexpr):
    """Writes the rows whose bits are set, rising; ``ends`` counts them up to the end of each brick."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    first, second = tl.load(words + 2 * i, i < size, 0), tl.load(words + 2 * i + 1, i < size, 0)
    is_read = (first | second) != 0
    at = tl.load(ends + i, is_read, 0) - _bits(first) - _bits(second)
    for bit in tl.static_range(64):
        word = first if bit < 32 else second
        is_set = ((word >> (bit % 32)) & 1) == 1
        tl.store(unique + at, i.to(tl.int64) * 64 + bit, is_set)
        at += is_set.to(tl.int32)


@triton.jit(do_not_specialize=("count",))
def position_kernel(rows, words, ends, positions, count, BLOCK: tl.constexpr):
    """Place of every entry among the distinct rows."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = tl.load(rows + i, i < count, 0)
    brick, is_second = row >> 6, ((row >> 5) & 1) == 1
    word = tl.load(words + (row >> 5), i < count, 0)
    not_before = word & (-1 << (row & 31).to(tl.int32))  # the row's own bit and those above it
    later = tl.load(words + 2 * brick + 1, (i < count) & (is_second == 0), 0)
    end = tl.load(ends + brick, i < count, 0)
    tl.store(positions + i, end - _bits(not_before) - _bits(later), i < count)


def index_rows(rows: Tensor, table_rows: int, pads: bool) -> RowIndex:
    """A bit for every row of the table, and a running count of them by bricks."""
    flat, device, block = rows.reshape(-1).contiguous(), rows.device, block_size(ROWS, rows.device)
    count, bricks = len(flat), -(-table_rows // BRICK)
    positions = torch.empty(rows.shape, dtype=torch.int32, device=device)
    if not count:
        return RowIndex(flat, positions)
    words = torch.zeros(2 * bricks, dtype=torch.int32, device=device)
    counts = torch.empty(bricks, dtype=torch.int32, device=device)
    launch(mark_kernel, count, block, flat, words, count, BLOCK=block)
    launch(count_kernel, bricks, block, words, counts, bricks, BLOCK=block)
    ends = counts.cumsum(0, dtype=torch.int32)
    distinct = min(count, table_rows) if pads else int(ends[-1])
    unique = torch.zeros(distinct, dtype=torch.int64, device=device)
    launch(list_kernel, bricks, block, words, ends, unique, bricks, BLOCK=block)
    launch(position_kernel, count, block, flat, words, ends, positions, count, BLOCK=block)
    return RowIndex(unique, positions)
