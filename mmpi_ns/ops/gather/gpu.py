"""Sums along rays on a GPU. Gradients of texels are atomic sums, so their last bits may differ from run to run."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.gather import COLORS, RaySums, Taps, number_samples
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


# Slices of arrays begin at any address, and no variant is compiled for aligned ones.
@triton.jit(do_not_specialize=("num_rays", "slots", "planar", "positions", "shares", "cube_positions", "cube_shares"))
def gather_kernel(
    values, numbers, weights, positions, shares, cube_positions, cube_shares, sums, num_rays, slots, channels, planar,
    HAS_CUBE: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums over samples of weight times texel, of weight, and of weight times squared colour. ``numbers`` is the
    sample in each slot; the first ``planar`` are on planes."""
    ray, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)[None, :]
    inside = ray < num_rays
    mass = ray * 0.0
    total = mass[:, None] * column
    squares = total
    for s in range(slots):
        slot = ray.to(tl.int64) * slots + s
        number = tl.load(numbers + slot, inside, -1)
        on_plane, in_cube = (number >= 0) & (number < planar), number >= planar
        raw = _read_taps(values, positions, shares, number, on_plane, channels, column, 4)
        if HAS_CUBE:
            raw += _read_taps(values, cube_positions, cube_shares, number - planar, in_cube, channels, column, 8)
        weight = tl.load(weights + slot, number >= 0, 0.0)
        value = weight[:, None] * activate(raw, column)
        total += value
        squares += value * activate(raw, column)
        mass += weight
    to = sums + ray[:, None] * (channels + 4)
    tl.store(to + column, total, inside[:, None] & (column < channels))
    tl.store(sums + ray * (channels + 4) + channels, mass, inside)
    tl.store(to + channels + 1 + column, squares, inside[:, None] & (column < 3))


@triton.jit(
    do_not_specialize=("first", "count", "slots_per_ray", "positions", "shares", "to_sums", "to_first", "to_second"),
)
def gather_back_kernel(
    values, slots, chosen, weights, positions, shares, to_sums, to_first, to_second, to_values, to_weights, to_shares,
    first, count, slots_per_ray, channels, NEEDED: tl.constexpr, MOVED: tl.constexpr, TAPS: tl.constexpr,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of texels (added to what is there), weights and shares, the first and the last where NEEDED and where
    samples may be MOVED; a lane a sample, the ``first`` one and those after."""
    number, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)[None, :]
    inside = number < count
    slot = tl.load(slots + first + number, inside, 0)
    ray = slot // slots_per_ray
    inside = inside & (tl.load(chosen + ray, inside, 0) != 0)
    value = activate(_read_taps(values, positions, shares, number, inside, channels, column, TAPS), column)
    filled, is_color = inside[:, None] & (column < channels), inside[:, None] & (column < 3)
    slope = tl.load(to_sums + ray[:, None] * channels + column, filled, 0.0)
    tl.store(to_weights + slot, tl.sum(slope * value, 1), inside)
    if NEEDED or MOVED:
        slope += tl.load(to_first + ray[:, None] * 3 + column, is_color, 0.0)
        slope += 2 * value * tl.load(to_second + ray[:, None] * 3 + column, is_color, 0.0)
        inner = tl.where(column < 3, value * (1 - value), 1 - value * value)
        down = tl.load(weights + slot, inside, 0.0)[:, None] * slope * inner
        for tap in tl.static_range(TAPS):
            row = tl.load(positions + number * TAPS + tap, inside, 0).to(tl.int64)
            at = row[:, None] * channels + column
            if NEEDED:
                share = tl.load(shares + number * TAPS + tap, inside, 0.0)
                # Zero terms are skipped: all samples that pad a capacity read the same few texels.
                tl.atomic_add(to_values + at, share[:, None] * down, filled & (down != 0), sem="relaxed")
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
        ctx: Any, values: Tensor, weights: Tensor, slots: Tensor, chosen: Tensor, *taps: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        saved = [x.contiguous() for x in (values, weights, slots, chosen, *taps)]
        values, weights, slots, chosen, positions, shares, cube_positions, cube_shares = saved
        (num_rays, width), channels, device = weights.shape, values.shape[1], values.device
        numbers = number_samples(slots, chosen, weights)
        sums = torch.zeros(num_rays, channels + 1 + COLORS, device=device)
        columns, block, warps = sizes(channels, device)
        tensors = (values, numbers, weights, positions, shares, cube_positions, cube_shares, sums)
        launch(
            gather_kernel, num_rays if len(slots) else 0, block, *tensors, num_rays, width, channels, len(positions),
            HAS_CUBE=len(cube_positions) > 0, CHANNELS=columns, BLOCK=block, num_warps=warps,
        )  # fmt: skip
        ctx.save_for_backward(*saved)
        gathered, mass, second = sums.split([channels, 1, COLORS], -1)
        ctx.mark_non_differentiable(mass)
        return gathered, mass, gathered[:, :COLORS].clone(), second

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        values, weights, slots, chosen, *taps = ctx.saved_tensors
        to_sums, _, to_first, to_second = (g.contiguous() for g in grad_outputs)
        needed, channels = ctx.needs_input_grad[0], values.shape[1]
        to_values, to_weights = torch.zeros_like(values) if needed else values, torch.zeros_like(weights)
        columns, block, warps = sizes(channels, values.device)
        moved, first = any(ctx.needs_input_grad[5::2]), 0
        to_shares = [torch.zeros_like(x) if moved else to_weights for x in taps[1::2]]  # not written where unmoved
        for positions, shares, to in zip(taps[::2], taps[1::2], to_shares, strict=True):
            launch(
                gather_back_kernel, len(positions), block, values, slots, chosen, weights, positions, shares,
                to_sums, to_first, to_second, to_values, to_weights, to, first, len(positions), weights.shape[1],
                channels, NEEDED=needed, MOVED=moved, TAPS=shares.shape[1], CHANNELS=columns, BLOCK=block,
                num_warps=warps,
            )  # fmt: skip
            first += len(positions)
        tensors = (x if moved else None for to in to_shares for x in (None, to))
        return to_values if needed else None, to_weights, None, None, *tensors


def gather_taps(values: Tensor, taps: list[Taps], slots: Tensor, weights: Tensor, chosen: Tensor) -> RaySums:
    parts = {t.weights.shape[1]: (t.positions, t.weights) for t in taps}
    none = {n: (slots.new_zeros(0, n), weights.new_zeros(0, n)) for n in (4, 8)}
    tensors = [x for pair in (none | parts).values() for x in pair]
    return RaySums(*_GatherTaps.apply(values, weights, slots, chosen, *tensors))  # type: ignore[misc]
