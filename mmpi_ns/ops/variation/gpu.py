"""Total variation on a GPU: value and gradient in one launch."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.gpu_scene import DEPTH, HEIGHT, INTS, STORED, WIDTH, block_size, grids_of, launch, row_of, texel_of
from mmpi_ns.ops.layout import SceneLayout, dense
from mmpi_ns.ops.variation import WithGradient, weigh_chroma

ROWS = 128
"""Texels per program."""


@triton.jit(do_not_specialize=("count", "rows", "values"))
def variation_kernel(
    rows, values, table, grids, scales, gradient, totals, count, channels,
    NUM_HEADS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Huber loss of the differences of texels with their neighbours, which are held fixed, and its gradient."""
    i, c = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)
    inside, is_channel = i < count, (c < channels)[None, :]
    head, plane, y, x, inside = texel_of(grids, tl.load(rows + i, inside, 0), inside, NUM_HEADS)
    grid = grids + head * INTS
    center = tl.load(values + i[:, None] * channels + c[None, :], inside[:, None] & is_channel, 0.0)
    slope, total = center * 0, center * 0
    for way in tl.static_range(6):
        axis, side = way // 2, way % 2 * 2 - 1
        nx, ny, nz = x + (side if axis == 0 else 0), y + (side if axis == 1 else 0), plane + (side if axis == 2 else 0)
        exists = inside & (nx >= 0) & (nx < tl.load(grid + WIDTH)) & (ny >= 0) & (ny < tl.load(grid + HEIGHT))
        exists = exists & (nz >= 0) & (nz < tl.load(grid + DEPTH))
        row = row_of(grids, head, nz, ny, nx, exists)
        exists = (exists & (row >= STORED))[:, None] & is_channel
        difference = tl.where(exists, center - tl.load(table + row[:, None] * channels + c[None, :], exists, 0.0), 0.0)
        size, scale = tl.abs(difference), tl.load(scales + 3 * head + axis)[:, None] / 6
        slope += scale * tl.minimum(tl.maximum(difference, -1.0), 1.0)
        total += scale * tl.where(size <= 1, 0.5 * difference * difference, size - 0.5)
    tl.store(gradient + i[:, None] * channels + c[None, :], slope, (i < count)[:, None] & is_channel)
    tl.store(totals + tl.program_id(0), tl.sum(tl.sum(total, 1), 0))


def total_variation(
    values: Tensor, table: Tensor, rows: Tensor, layout: SceneLayout, scales: Tensor, chroma: float = 0.0
) -> Tensor:
    (count, channels), device, block = values.shape, values.device, block_size(ROWS, values.device)
    gradient, totals = torch.empty_like(values), torch.zeros(max(1, triton.cdiv(count, block)), device=device)
    tensors = (rows.contiguous(), values.contiguous(), table, grids_of(layout), *dense(scales), gradient, totals)
    launch(
        variation_kernel, count, block, *tensors, count, channels, NUM_HEADS=len(scales),
        CHANNELS=triton.next_power_of_2(channels), BLOCK=block,
    )  # fmt: skip
    if chroma > 0:
        gradient = weigh_chroma(gradient, chroma)
    return WithGradient.apply(values, totals.sum(), gradient)  # type: ignore[no-any-return]
