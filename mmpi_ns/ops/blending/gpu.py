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
"""Of a program."""


@triton.jit(do_not_specialize=("count",))
def votes_kernel(
    origins, directions, rays, inverse_ts, heads, constants, grids, cube, touched, rows, weights, cover, count,
    K: tl.constexpr, HAS_CUBE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    asked = i < count
    ray, inverse_t, own = tl.load(rays + i, asked, 0), tl.load(inverse_ts + i, asked, 0.0), tl.load(heads + i, asked, 0)
    x, y, z = (tl.load(origins + 3 * ray), tl.load(origins + 3 * ray + 1), tl.load(origins + 3 * ray + 2))
    dx, dy, dz = (tl.load(directions + 3 * ray), tl.load(directions + 3 * ray + 1), tl.load(directions + 3 * ray + 2))
    for k in tl.static_range(K + HAS_CUBE):
        if k < K:
            u, v, s, inside = in_mpi(constants, k, x, y, z, dx, dy, dz, inverse_t)
        else:
            u, v, s, inside = in_cube(cube, x, y, z, dx, dy, dz, inverse_t)
        is_own = own == k
        reads = asked & (inside | is_own)
        grid, to = grids + k * INTS, i.to(tl.int64) * (K + HAS_CUBE) + k
        near = (nearest(v, tl.load(grid + HEIGHT)), nearest(u, tl.load(grid + WIDTH)))
        row = row_of(grids, k, nearest(s, tl.load(grid + DEPTH)), near[0], near[1], reads)
        trained = reads & (tl.load(touched + row, reads, 0) > 0)
        tl.store(cover + to, trained | is_own, asked)
        px, fx = cell(u, tl.load(grid + WIDTH))
        py, fy = cell(v, tl.load(grid + HEIGHT))
        pz, fz = cell(s, tl.load(grid + DEPTH))
        for tap in tl.static_range(8):
            tx, ty, tz = tap % 2, tap // 2 % 2, tap // 4
            share = (fx if tx else 1 - fx) * (fy if ty else 1 - fy) * (fz if tz else 1 - fz)
            row = row_of(grids, k, pz + tz, py + ty, px + tx, reads)
            tl.store(rows + 8 * to + tap, tl.where(reads, row, 0), asked)
            tl.store(weights + 8 * to + tap, share, asked)


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
        votes_kernel, count, block, *samples, head_rows, grids_of(layout), cube_row, touched.contiguous(),
        rows, weights, cover, count, K=len(layout.mpis), HAS_CUBE=layout.cube is not None, BLOCK=block,
    )  # fmt: skip
    return Votes(rows, weights, cover)
