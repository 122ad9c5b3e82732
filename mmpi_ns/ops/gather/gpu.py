"""Sums along rays on a GPU. Gradients of texels are atomic sums, so their last bits may differ from run to run."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.composite import ray_numbers
from mmpi_ns.ops.gather import COLORS, RaySums, Taps
from mmpi_ns.ops.gpu_scene import block_size, launch

NUMBERS = 512
"""Rays or samples per program times their channels, limited by its registers."""


@triton.jit
def activate(raw, column):
    """Colours and features of samples."""
    share = 1 / (1 + tl.exp(-tl.where(column < 3, raw, 2 * raw)))
    return tl.where(column < 3, share, 2 * share - 1)


@triton.jit
def _read_taps(values, positions, shares, number, inside, channels, column, TAPS: tl.constexpr):
    """Sums over taps of share times row of a table."""
    raw = number[:, None] * column * 0.0
    for tap in tl.static_range(TAPS):
        row = tl.load(positions + number * TAPS + tap, inside, 0).to(tl.int64)
        share = tl.load(shares + number * TAPS + tap, inside, 0.0)
        read = tl.load(values + row[:, None] * channels + column, inside[:, None] & (column < channels), 0.0)
        raw += share[:, None] * read
    return raw


@triton.jit(do_not_specialize=("num_rays",))
def gather_kernel(
    values, positions, shares, starts, weights, chosen, gathered, masses, firsts, seconds, num_rays, channels,
    TAPS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums over samples of weight times texel, of weight, and of weight times squared colour, of the chosen rays."""
    ray, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)[None, :]
    inside = ray < num_rays
    start, asked = tl.load(starts + ray, inside, 0), tl.load(chosen + ray, inside, 0) != 0
    count = tl.where(asked, tl.load(starts + ray + 1, inside, 0) - start, 0)
    mass = ray * 0.0
    total = mass[:, None] * column
    squares = total
    for s in range(tl.max(count, 0)):
        has = s < count
        raw = _read_taps(values, positions, shares, start + s, has, channels, column, TAPS)
        weight = tl.load(weights + start + s, has, 0.0)
        value = weight[:, None] * activate(raw, column)
        total += value
        squares += value * activate(raw, column)
        mass += weight
    filled, is_color, of_color = inside[:, None] & (column < channels), inside[:, None] & (column < 3), 3 * ray[:, None]
    tl.store(gathered + ray[:, None] * channels + column, total, filled)
    tl.store(masses + ray, mass, inside)
    tl.store(firsts + of_color + column, total, is_color)
    tl.store(seconds + of_color + column, squares, is_color)


@triton.jit(do_not_specialize=("count", "num_rays"))
def gather_back_kernel(
    values, positions, shares, rays, weights, chosen, to_sums, to_first, to_second, to_values, to_weights, to_shares,
    count, num_rays, channels, NEEDED: tl.constexpr, MOVED: tl.constexpr, TAPS: tl.constexpr,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of texels (added to what is there), weights and shares, the first and the last where NEEDED and where
    samples may be MOVED; a lane a sample."""
    number, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)[None, :]
    ray = tl.load(rays + number, number < count, num_rays)
    inside = ray < num_rays
    inside = inside & (tl.load(chosen + ray, inside, 0) != 0)
    value = activate(_read_taps(values, positions, shares, number, inside, channels, column, TAPS), column)
    filled, is_color = inside[:, None] & (column < channels), inside[:, None] & (column < 3)
    slope = tl.load(to_sums + ray[:, None] * channels + column, filled, 0.0)
    tl.store(to_weights + number, tl.sum(slope * value, 1), inside)
    if NEEDED or MOVED:
        slope += tl.load(to_first + ray[:, None] * 3 + column, is_color, 0.0)
        slope += 2 * value * tl.load(to_second + ray[:, None] * 3 + column, is_color, 0.0)
        inner = tl.where(column < 3, value * (1 - value), 1 - value * value)
        down = tl.load(weights + number, inside, 0.0)[:, None] * slope * inner
        for tap in tl.static_range(TAPS):
            row = tl.load(positions + number * TAPS + tap, inside, 0).to(tl.int64)
            at = row[:, None] * channels + column
            if NEEDED:
                share = tl.load(shares + number * TAPS + tap, inside, 0.0)
                tl.atomic_add(to_values + at, share[:, None] * down, filled, sem="relaxed")
            if MOVED:
                read = tl.load(values + at, filled, 0.0)
                tl.store(to_shares + number * TAPS + tap, tl.sum(read * down, 1), inside)


def sizes(channels: int, device: torch.device, numbers: int = NUMBERS) -> tuple[int, int, int]:
    """Columns, rays or samples, and warps of a program that holds this many numbers; a lane for each ray or sample,
    without repeated work."""
    columns = max(4, int(triton.next_power_of_2(channels)))  # colours take three, however few there are
    block = block_size(max(8, numbers // columns), device)
    return columns, block, min(4, max(1, block // 32))


class _GatherTaps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, positions: Tensor, shares: Tensor, starts: Tensor, weights: Tensor, chosen: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        saved = [x.contiguous() for x in (values, positions, shares, starts, weights, chosen)]
        channels, device = values.shape[1], values.device
        sums = [torch.empty(len(chosen), n, device=device) for n in (channels, 1, COLORS, COLORS)]
        columns, block, warps = sizes(channels, device)
        launch(
            gather_kernel, len(chosen), block, *saved, *sums, len(chosen), channels,
            TAPS=shares.shape[1], CHANNELS=columns, BLOCK=block, num_warps=warps,
        )  # fmt: skip
        ctx.save_for_backward(*saved)
        ctx.mark_non_differentiable(sums[1])
        return tuple(sums)  # type: ignore[return-value]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        values, positions, shares, starts, weights, chosen = ctx.saved_tensors
        to_sums, _, to_first, to_second = (g.contiguous() for g in grad_outputs)
        needed, _, moved, *_ = ctx.needs_input_grad
        to_values, to_weights = torch.zeros_like(values) if needed else values, torch.zeros_like(weights)
        to_shares = torch.zeros_like(shares) if moved else to_weights  # not written where unmoved
        columns, block, warps = sizes(values.shape[1], values.device)
        launch(
            gather_back_kernel, len(weights), block, values, positions, shares, ray_numbers(starts, len(weights)),
            weights, chosen, to_sums, to_first, to_second, to_values, to_weights, to_shares, len(weights), len(chosen),
            values.shape[1], NEEDED=needed, MOVED=moved, TAPS=shares.shape[1], CHANNELS=columns, BLOCK=block,
            num_warps=warps,
        )  # fmt: skip
        return to_values if needed else None, None, to_shares if moved else None, None, to_weights, None


def gather_taps(values: Tensor, taps: Taps, starts: Tensor, weights: Tensor, chosen: Tensor | None = None) -> RaySums:
    asked = torch.ones_like(starts[1:], dtype=torch.bool) if chosen is None else chosen
    sums = _GatherTaps.apply(values, taps.positions, taps.weights, starts, weights, asked)
    return RaySums(*sums)  # type: ignore[misc]
