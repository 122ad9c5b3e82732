"""Rows and weights of texels on a GPU, in one launch."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops import interpolate as definition
from mmpi_ns.ops.gpu_scene import HEIGHT, INTS, WIDTH, block_size, cell, grids_of, launch, row_of
from mmpi_ns.ops.layout import SceneLayout

SAMPLES = 256
"""Of a program."""


@triton.jit(do_not_specialize=("count", "heads", "planes", "ndc"))
def texel_rows_kernel(heads, planes, ndc, grids, rows, weights, count, BLOCK: tl.constexpr):
    """The four texels around samples on planes."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    head, plane = tl.load(heads + i, inside, 0).to(tl.int32), tl.load(planes + i, inside, 0)
    x, fx = cell(tl.load(ndc + 3 * i, inside, 0.0), tl.load(grids + head * INTS + WIDTH))
    y, fy = cell(tl.load(ndc + 3 * i + 1, inside, 0.0), tl.load(grids + head * INTS + HEIGHT))
    to = 4 * i.to(tl.int64)
    for tap in tl.static_range(4):
        dy, dx = tap // 2, tap % 2
        tl.store(rows + to + tap, row_of(grids, head, plane, y + dy, x + dx, inside), inside)
        tl.store(weights + to + tap, (fx if dx else 1 - fx) * (fy if dy else 1 - fy), inside)


def texel_rows(layout: SceneLayout, heads: Tensor, planes: Tensor, ndc: Tensor) -> tuple[Tensor, Tensor]:
    if ndc.requires_grad:
        return definition.texel_rows.reference(layout, heads, planes, ndc)
    count, device, block = len(heads), heads.device, block_size(SAMPLES, heads.device)
    rows = torch.empty(count, 4, dtype=torch.int64, device=device)
    weights = torch.empty(count, 4, device=device)
    samples = (x.contiguous() for x in (heads, planes, ndc))
    launch(texel_rows_kernel, count, block, *samples, grids_of(layout), rows, weights, count, BLOCK=block)
    return rows, weights
