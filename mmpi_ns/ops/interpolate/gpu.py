"""Rows and weights of the texels around samples, on a GPU; a lane a sample."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops import interpolate as definition
from mmpi_ns.ops.gpu_scene import DEPTH, HEIGHT, INTS, STORED, WIDTH, block_size, cell, grids_of, launch, row_of
from mmpi_ns.ops.layout import SceneLayout, dense

SAMPLES = 128
"""Samples per program."""


@triton.jit(do_not_specialize=("count", "num_mpis"))
def texel_rows_kernel(
    heads, planes, ndc, grids, kept, rows, weights, count, num_mpis, ENDS: tl.constexpr, TAPS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Four texels of a plane, or eight of the cube; where there is one, samples on planes have theirs again, with
    weight 0. The empty brick for samples from ``kept`` on, if the list ENDS there."""
    number = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = number < count
    head, z = tl.load(heads + number, inside, 0), tl.load(planes + number, inside, 0)
    grid, at, to = grids + head * INTS, ndc + 3 * number, TAPS * number.to(tl.int64)
    x, fx = cell(tl.load(at, inside, 0.0), tl.load(grid + WIDTH))
    y, fy = cell(tl.load(at + 1, inside, 0.0), tl.load(grid + HEIGHT))
    in_cube, fz = head >= num_mpis, fx * 0.0
    if TAPS == 8:
        lower, fraction = cell(tl.load(at + 2, inside, 0.0), tl.load(grid + DEPTH))
        z, fz = tl.where(in_cube, lower, z), tl.where(in_cube, fraction, 0.0)
    for tap in tl.static_range(TAPS):
        across, down = tap % 2, tap // 2 % 2
        behind = z + in_cube.to(tl.int32) if tap >= 4 else z
        weight = (fx if across else 1 - fx) * (fy if down else 1 - fy) * (fz if tap >= 4 else 1 - fz)
        row = row_of(grids, head, behind, y + down, x + across, inside)
        if ENDS:
            row = tl.where(number < tl.load(kept), row, number % STORED)
        tl.store(rows + to + tap, row, inside)
        tl.store(weights + to + tap, weight, inside)


def texel_rows(
    layout: SceneLayout, heads: Tensor, planes: Tensor, ndc: Tensor, count: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    if ndc.requires_grad:
        return definition.texel_rows.reference(layout, heads, planes, ndc, count)
    shape, device = (len(heads), 4 if layout.cube is None else 8), heads.device
    rows, weights = torch.empty(shape, dtype=torch.int64, device=device), torch.empty(shape, device=device)
    samples, ends = (heads.contiguous(), planes.contiguous(), *dense(ndc)), count is not None
    tensors = (*samples, grids_of(layout), count if ends else rows, rows, weights)
    sizes, block = (len(heads), len(layout.mpis)), block_size(SAMPLES, device)
    launch(texel_rows_kernel, len(heads), block, *tensors, *sizes, ENDS=ends, TAPS=shape[1], BLOCK=block)
    return rows, weights
