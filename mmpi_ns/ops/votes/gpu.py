"""Texels of the heads that cover samples, on a GPU."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.gpu_scene import DEPTH, HEIGHT, INTS, WIDTH, block_size, cell, grids_of, launch, row_of, vectors
from mmpi_ns.ops.layout import SceneLayout, Tables, dense
from mmpi_ns.ops.march.gpu_walk import in_cube, in_mpi, was_trained
from mmpi_ns.ops.votes import Votes, empty_votes

PAIRS = 128
"""Samples per program times their heads."""


@triton.jit(do_not_specialize=("pairs",))
def votes_kernel(
    origins, directions, inverse_ts, heads, constants, grids, cube, touched, places, rows, weights, pairs,
    K: tl.constexpr, HAS_CUBE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The vote of a head on a sample, one lane each."""
    pair = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists, head = pair < pairs, pair % (K + HAS_CUBE)
    sample = tl.where(exists, pair // (K + HAS_CUBE), 0)
    x, y, z = vectors(origins, sample)
    dx, dy, dz = vectors(directions, sample)
    inverse_t = tl.load(inverse_ts + sample)
    u, v, s, inside = in_mpi(constants, tl.where(head < K, head, 0), x, y, z, dx, dy, dz, inverse_t)
    if HAS_CUBE:
        p, q, r, is_in = in_cube(cube, x, y, z, dx, dy, dz, inverse_t)
        u, v, s = tl.where(head < K, u, p), tl.where(head < K, v, q), tl.where(head < K, s, r)
        inside = tl.where(head < K, inside, is_in)
    covers = was_trained(touched, grids, head, u, v, s, exists & inside)
    covers = covers | (exists & (tl.load(heads + sample) == head))
    grid, to = grids + head * INTS, 8 * pair.to(tl.int64)
    left, fx = cell(u, tl.load(grid + WIDTH))
    top, fy = cell(v, tl.load(grid + HEIGHT))
    near, fz = cell(s, tl.load(grid + DEPTH))
    for tap in tl.static_range(8):
        across, down, behind = tap % 2, tap // 2 % 2, tap // 4
        row = row_of(grids, head, near + behind, top + down, left + across, covers)
        weight = (fx if across else 1 - fx) * (fy if down else 1 - fy) * (fz if behind else 1 - fz)
        tl.store(rows + to + tap, tl.where(covers, row, 0), exists)
        tl.store(weights + to + tap, tl.where(covers, weight, 0.0), exists)
    tl.store(places + pair, tl.where(covers, pair, pairs).to(tl.int64), exists)


def find_votes(
    layout: SceneLayout, tables: Tables, origins: Tensor, directions: Tensor, inverse_t: Tensor, heads: Tensor
) -> Votes:
    pairs, device, (constants, _, cube) = len(heads) * layout.num_heads, heads.device, layout.constants
    votes, block = empty_votes(pairs, device), block_size(PAIRS, device)
    launch(
        votes_kernel, pairs, block, *dense(origins, directions, inverse_t), heads.contiguous(),
        constants, grids_of(layout), cube, tables.touched, *votes, pairs,
        K=len(layout.mpis), HAS_CUBE=layout.cube is not None, BLOCK=block,
    )  # fmt: skip
    return votes
