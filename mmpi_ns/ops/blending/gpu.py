"""Texels of every head around samples on a GPU, in one launch."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.blending import Votes
from mmpi_ns.ops.gpu_scene import DEPTH, HEIGHT, INTS, WIDTH, block_size, cell, grids_of, launch, nearest, row_of
from mmpi_ns.ops.layout import SceneLayout, dense
from mmpi_ns.ops.march.gpu_walk import in_cube, in_mpi

SAMPLES = 128
"""Of a program, each with a head."""


@triton.jit(do_not_specialize=("count", "num_heads"))
def votes_kernel(
    origins, directions, rays, inverse_ts, heads, constants, grids, cube, touched, rows, weights, cover, count,
    num_heads, HAS_CUBE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A lane a sample and head."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    asked = i < count * num_heads
    sample, k = i // num_heads, (i % num_heads).to(tl.int32)
    ray, own = tl.load(rays + sample, asked, 0), tl.load(heads + sample, asked, 0)
    inverse_t = tl.load(inverse_ts + sample, asked, 0.0)
    x, y, z = tl.load(origins + 3 * ray), tl.load(origins + 3 * ray + 1), tl.load(origins + 3 * ray + 2)
    dx, dy, dz = tl.load(directions + 3 * ray), tl.load(directions + 3 * ray + 1), tl.load(directions + 3 * ray + 2)
    on_planes = k < num_heads - HAS_CUBE
    u, v, s, inside = in_mpi(constants, tl.where(on_planes, k, 0), x, y, z, dx, dy, dz, inverse_t)
    if HAS_CUBE:
        p, q, r, within = in_cube(cube, x, y, z, dx, dy, dz, inverse_t)
        u, v, s = tl.where(on_planes, u, p), tl.where(on_planes, v, q), tl.where(on_planes, s, r)
        inside = tl.where(on_planes, inside, within)
    reads, grid = asked & (inside | (own == k)), grids + k * INTS
    width, height, depth = tl.load(grid + WIDTH), tl.load(grid + HEIGHT), tl.load(grid + DEPTH)
    row = row_of(grids, k, nearest(s, depth), nearest(v, height), nearest(u, width), reads)
    tl.store(cover + i, (reads & (tl.load(touched + row, reads, 0) > 0)) | (own == k), asked)
    px, fx = cell(u, width)
    py, fy = cell(v, height)
    pz, fz = cell(s, depth)
    for tap in tl.static_range(8):
        tx, ty, tz = tap % 2, tap // 2 % 2, tap // 4
        share = (fx if tx else 1 - fx) * (fy if ty else 1 - fy) * (fz if tz else 1 - fz)
        row = row_of(grids, k, pz + tz, py + ty, px + tx, reads)
        tl.store(rows + 8 * i + tap, tl.where(reads, row, 0), asked)
        tl.store(weights + 8 * i + tap, share, asked)


def voting_texels(
    layout: SceneLayout,
    touched: Tensor,
    origins: Tensor,
    directions: Tensor,
    rays: Tensor,
    inverse_t: Tensor,
    heads: Tensor,
) -> Votes:
    count, num_heads, device = len(heads), layout.num_heads, heads.device
    rows = torch.empty(count, num_heads, 8, dtype=torch.int64, device=device)
    weights = torch.empty(count, num_heads, 8, device=device)
    cover = torch.empty(count, num_heads, dtype=torch.bool, device=device)
    block, (head_rows, _, cube_row) = block_size(SAMPLES, device), layout.constants
    samples = (*dense(origins, directions), rays.contiguous(), inverse_t.contiguous(), heads.contiguous())
    launch(
        votes_kernel, count * num_heads, block, *samples, head_rows, grids_of(layout), cube_row, touched.contiguous(),
        rows, weights, cover, count, num_heads, HAS_CUBE=layout.cube is not None, BLOCK=block,
    )  # fmt: skip
    return Votes(rows, weights, cover)
