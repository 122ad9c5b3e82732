"""Texels of the heads that cover samples, and blending by their reliability, on a GPU."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.gpu_scene import DEPTH, HEIGHT, INTS, WIDTH, block_size, cell, grids_of, launch, row_of, vectors
from mmpi_ns.ops.layout import SceneLayout, Tables, dense
from mmpi_ns.ops.march.gpu_walk import blend, in_cube, in_mpi, softplus, was_trained
from mmpi_ns.ops.votes import Votes, empty_votes

PAIRS, SAMPLES = 128, 128
"""Samples per program times their heads, and samples per program."""


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


# Shares --------------------------------------------------------------------------------------------------------------


@triton.jit
def _count(reliability, covers, at, mask, others, own):
    """Reliability of a head at samples, and whether it covers them and is not their own."""
    is_other = mask & others & (tl.load(covers + at, mask, 0) != 0)
    return tl.load(reliability + at, is_other | (mask & own), 0.0), is_other


@triton.jit(do_not_specialize=("count",))
def shares_kernel(
    reliability, covers, heads, log_shares, log_rests, to_share, to_rest, gradient, count, num_heads,
    BACK: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Logarithms of the shares of samples' heads and of their complements; or, BACK, the gradient of reliabilities."""
    sample = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, first = sample < count, sample.to(tl.int64) * num_heads
    head = tl.load(heads + sample, inside, 0)
    own = tl.load(reliability + first + head, inside, 0.0)
    highest, total = own * 0 - 1e30, own * 0
    for k in range(num_heads):
        value, counts = _count(reliability, covers, first + k, inside, head != k, head == k)
        higher = tl.where(counts, tl.maximum(highest, value), highest)
        total = tl.where(counts, total * tl.exp(highest - higher) + tl.exp(value - higher), total)
        highest = higher
    sole = total == 0
    odds = tl.where(sole, 0.0, highest - own + tl.log(tl.where(sole, 1.0, total)))
    log_share, log_rest = -softplus(odds), -softplus(-odds)
    if BACK:
        slope = tl.load(to_rest + sample, inside, 0.0) * tl.exp(log_share)
        slope = tl.where(sole, 0.0, slope - tl.load(to_share + sample, inside, 0.0) * tl.exp(log_rest))
        for k in range(num_heads):
            value, counts = _count(reliability, covers, first + k, inside, head != k, head == k)
            of_other = tl.where(counts, slope * tl.exp(value - highest) / tl.where(sole, 1.0, total), 0.0)
            tl.store(gradient + first + k, tl.where(head == k, -slope, of_other), inside)
    else:
        tl.store(log_shares + sample, tl.where(sole, 0.0, log_share), inside)
        tl.store(log_rests + sample, tl.where(sole, -float("inf"), log_rest), inside)


@triton.jit(do_not_specialize=("count",))
def blend_kernel(
    taus, log_shares, log_rests, blended, slopes, to_tau, to_share, to_rest, count, BACK: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Optical depths after blending; or, BACK, the gradients of all three."""
    sample = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = sample < count
    tau, log_share = tl.load(taus + sample, inside, 0.0), tl.load(log_shares + sample, inside, 0.0)
    log_rest = tl.load(log_rests + sample, inside, 0.0)
    sole = log_rest == -float("inf")
    depth, alpha = blend(tau, log_share, tl.where(sole, 0.0, log_rest), sole)
    if BACK:
        slope, thin = tl.load(slopes + sample, inside, 0.0), alpha < 0.5
        passed = tl.exp(log_share - tau + depth)
        of_share = tl.where(thin, alpha / (1 - tl.minimum(alpha, 0.5)), -passed)
        tl.store(to_tau + sample, slope * tl.where(sole, 1.0, passed), inside)
        tl.store(to_share + sample, tl.where(sole, 0.0, slope * of_share), inside)
        tl.store(to_rest + sample, tl.where(sole | thin, 0.0, slope * (passed - 1)), inside)
    else:
        tl.store(blended + sample, depth, inside)


class _Shares(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> tuple[Tensor, Tensor]:
        reliability, _, heads = given
        shares, rests = torch.empty(2, len(heads), device=heads.device)
        block = block_size(SAMPLES, heads.device)
        tensors = (*given, shares, rests, shares, shares, shares)
        launch(shares_kernel, len(heads), block, *tensors, *reliability.shape, BACK=False, BLOCK=block)
        ctx.save_for_backward(*given)
        return shares, rests

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        reliability, *others = ctx.saved_tensors
        gradient, block = torch.empty_like(reliability), block_size(SAMPLES, reliability.device)
        slopes = [x.contiguous() for x in grad_outputs]
        tensors = (reliability, *others, *slopes, *slopes, gradient)
        launch(shares_kernel, len(gradient), block, *tensors, *gradient.shape, BACK=True, BLOCK=block)
        return gradient, None, None


class _Blended(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> Tensor:
        blended, block = torch.empty_like(given[0]), block_size(SAMPLES, given[0].device)
        tensors = (*given, blended, blended, blended, blended, blended)
        launch(blend_kernel, len(blended), block, *tensors, len(blended), BACK=False, BLOCK=block)
        ctx.save_for_backward(*given)
        return blended

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, ...]:
        slopes, saved = grad_outputs[0].contiguous(), ctx.saved_tensors
        gradients, block = tuple(torch.empty_like(slopes) for _ in saved), block_size(SAMPLES, slopes.device)
        tensors = (*saved, slopes, slopes, *gradients)
        launch(blend_kernel, len(slopes), block, *tensors, len(slopes), BACK=True, BLOCK=block)
        return gradients


def blend_shares(reliability: Tensor, covers: Tensor, heads: Tensor) -> tuple[Tensor, Tensor]:
    return _Shares.apply(*dense(reliability), covers.contiguous(), heads.contiguous())  # type: ignore[return-value]


def blended_optical_depth(tau: Tensor, log_share: Tensor, log_rest: Tensor) -> Tensor:
    return _Blended.apply(*dense(tau, log_share, log_rest))  # type: ignore[no-any-return]
