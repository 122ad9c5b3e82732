"""Rows of tables on a GPU: interpolation and its gradient, a batch's distinct rows, Adam on them, total variation.

The references are in ``ops/interpolate.py``, ``ops/variation.py``, ``touched_adam.py`` and ``texels.py``. Sums of
gradients are atomic, so their last bits may differ from run to run on a GPU.
"""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.triton_scene import (
    DEPTH,
    HEIGHT,
    INTS,
    WIDTH,
    TritonScene,
    block_size,
    cell,
    is_stored,
    place_of,
    row_of,
)

ROWS = 128
"""Samples, or rows, of a program."""


def works(device: str) -> None:
    """Runs a kernel and looks at what it wrote.

    Raises:
        Exception: whatever Triton, its compiler or the driver finds amiss.
    """
    table, rows = torch.arange(6.0, device=device).view(3, 2), torch.tensor([[2, 0]], device=device)
    out = interpolate(table, rows, torch.tensor([[0.5, 2.0]], device=device))
    if out.tolist() != [[2.0, 4.5]]:
        raise RuntimeError(f"a trial kernel wrote {out.tolist()} instead of [[2.0, 4.5]]")


# Which rows ---------------------------------------------------------------------------------------------------------


@triton.jit
def taps_kernel(
    heads, planes, places, grids, rows, weights, count, CUBE: tl.constexpr, TAPS: tl.constexpr, BLOCK: tl.constexpr
):
    """Rows and weights of samples: 4 texels of a plane, or 8 of the cube."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    head = tl.load(heads + i, inside, 0)
    grid = grids + head * INTS
    x, fx = cell(tl.load(places + 3 * i, inside, 0.0), tl.load(grid + WIDTH))
    y, fy = cell(tl.load(places + 3 * i + 1, inside, 0.0), tl.load(grid + HEIGHT))
    z, fz = cell(tl.load(places + 3 * i + 2, inside, 0.0), tl.load(grid + DEPTH))
    if not CUBE:
        z, fz = tl.load(planes + i, inside, 0), fz * 0
    for tap in tl.static_range(TAPS):
        dx, dy, dz = tap % 2, tap // 2 % 2, tap // 4
        weight = (fx if dx else 1 - fx) * (fy if dy else 1 - fy) * (fz if dz else 1 - fz)
        tl.store(rows + i * TAPS + tap, row_of(grids, head, z + dz, y + dy, x + dx, inside), inside)
        tl.store(weights + i * TAPS + tap, weight, inside)


def taps(
    scene: TritonScene, heads: Int[Tensor, "N"], planes: Int[Tensor, "N"], ndc: Float[Tensor, "N 3"], in_cube: bool
) -> tuple[Int[Tensor, "N B"], Float[Tensor, "N B"]]:
    """``TexelGrid.bilinear`` (or ``trilinear`` in the cube) of samples of several heads at once."""
    count, width = len(heads), 8 if in_cube else 4
    rows = torch.empty(count, width, dtype=torch.int64, device=ndc.device)
    weights = torch.empty(count, width, device=ndc.device)
    if count:
        block = block_size(ROWS, ndc.device)
        taps_kernel[(triton.cdiv(count, block),)](
            heads.contiguous(), planes.contiguous(), ndc.contiguous(), scene.grids, rows, weights, count,
            CUBE=in_cube, TAPS=width, BLOCK=block,
        )  # fmt: skip
    return rows, weights


# Interpolation ------------------------------------------------------------------------------------------------------


@triton.jit
def interpolate_kernel(
    table, rows, weights, out, count, channels, TAPS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    """out[n] = sum_b weights[n, b] table[rows[n, b]]."""
    i, c = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)
    inside = i < count
    both = inside[:, None] & (c < channels)[None, :]
    total = tl.zeros([BLOCK, CHANNELS], tl.float32)
    for tap in tl.static_range(TAPS):
        row = tl.load(rows + i * TAPS + tap, inside, 0).to(tl.int64)
        weight = tl.load(weights + i * TAPS + tap, inside, 0.0)
        total += weight[:, None] * tl.load(table + row[:, None] * channels + c[None, :], both, 0.0)
    tl.store(out + i[:, None] * channels + c[None, :], total, both)


def interpolate(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``interpolate_reference`` without gradients."""
    count, channels = len(rows), table.shape[1]
    out = torch.empty(count, channels, device=table.device)
    if count:
        block = block_size(ROWS, table.device)
        interpolate_kernel[(triton.cdiv(count, block),)](
            table, rows.contiguous(), weights.contiguous(), out, count, channels,
            TAPS=rows.shape[1], CHANNELS=triton.next_power_of_2(channels), BLOCK=block,
        )  # fmt: skip
    return out


@triton.jit
def scatter_kernel(
    positions, weights, values, out, count, channels,
    TAPS: tl.constexpr, WEIGHTED: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """out[positions[n, b]] += weights[n, b] values[n]."""
    i, c = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)
    inside = i < count
    both = inside[:, None] & (c < channels)[None, :]
    value = tl.load(values + i[:, None] * channels + c[None, :], both, 0.0)
    for tap in tl.static_range(TAPS):
        row = tl.load(positions + i * TAPS + tap, inside, 0).to(tl.int64)
        part = value
        if WEIGHTED:
            part = tl.load(weights + i * TAPS + tap, inside, 0.0)[:, None] * value
        tl.atomic_add(out + row[:, None] * channels + c[None, :], part, both, sem="relaxed")


def sum_by_position(
    position: Int[Tensor, "N B"], values: Float[Tensor, "N C"], weights: Float[Tensor, "N B"] | None, count: int
) -> Float[Tensor, "U C"]:
    """``ops.interpolate.sum_by_position`` by atomic additions."""
    entries, channels = values.shape
    out = torch.zeros(count, channels, device=values.device)
    if entries:
        block = block_size(ROWS, values.device)
        scatter_kernel[(triton.cdiv(entries, block),)](
            position.contiguous(), values if weights is None else weights.contiguous(), values.contiguous(), out,
            entries, channels, TAPS=1 if weights is None else weights.shape[1], WEIGHTED=weights is not None,
            CHANNELS=triton.next_power_of_2(channels), BLOCK=block,
        )  # fmt: skip
    return out


# Distinct rows ------------------------------------------------------------------------------------------------------


@triton.jit
def claim_kernel(rows, keys, numbers, slots, unique, found, count, last, shift, BLOCK: tl.constexpr):
    """Enters rows into a hash table of last + 1 = 2^(32 - shift) keys (-1: free); who enters one first numbers it."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    row = tl.load(rows + i, inside, 0)
    mixed = (row.to(tl.uint32) ^ (row >> 32).to(tl.uint32)) * 0x9E3779B1
    slot = (mixed >> shift.to(tl.uint32)).to(tl.int32)
    waiting, first = inside, i < 0
    while tl.max(waiting.to(tl.int32), 0) > 0:
        # Lanes that are done compare with -2, which no slot holds: a compare-and-swap has no mask.
        held = tl.atomic_cas(keys + slot, tl.where(waiting, -1, -2).to(tl.int64), row)
        first = first | (waiting & (held == -1))
        waiting = waiting & (held != -1) & (held != row)
        slot = tl.where(waiting, (slot + 1) & last, slot)
    mine = first.to(tl.int32)
    number = tl.atomic_add(found, tl.sum(mine, 0)) + tl.cumsum(mine, 0) - mine
    tl.store(unique + number, row, first)
    tl.store(numbers + slot, number, first)
    tl.store(slots + i, slot, inside)


@triton.jit
def number_kernel(slots, numbers, position, count, BLOCK: tl.constexpr):
    """position[i] = numbers[slots[i]]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tl.store(position + i, tl.load(numbers + tl.load(slots + i, i < count, 0), i < count, 0), i < count)


def index_rows(rows: Int[Tensor, "..."]) -> tuple[Int[Tensor, "U"], Int[Tensor, "..."]]:
    """Distinct rows in no particular order, and of every entry which one it is (int32).

    Waits for the device once, for how many there are.
    """
    flat, device = rows.reshape(-1).contiguous(), rows.device
    count = len(flat)
    if not count:
        return flat, torch.empty(rows.shape, dtype=torch.int32, device=device)
    bits = max(4, (2 * count - 1).bit_length())
    keys = torch.full((1 << bits,), -1, dtype=torch.int64, device=device)
    numbers = torch.empty(1 << bits, dtype=torch.int32, device=device)
    slots, position = (torch.empty(count, dtype=torch.int32, device=device) for _ in range(2))
    unique, found = torch.empty_like(flat), torch.zeros(1, dtype=torch.int32, device=device)
    block = block_size(ROWS, device)
    grid = (triton.cdiv(count, block),)
    claim_kernel[grid](flat, keys, numbers, slots, unique, found, count, (1 << bits) - 1, 32 - bits, BLOCK=block)
    number_kernel[grid](slots, numbers, position, count, BLOCK=block)
    return unique[: int(found)], position.view(rows.shape)


# Adam ---------------------------------------------------------------------------------------------------------------


@triton.jit
def adam_kernel(
    rows, grads, params, means, squares, size, channels, beta1, beta2, correction, eps, rate, BLOCK: tl.constexpr
):
    """Adam on distinct rows; entries whose gradient is exactly 0 are left alone."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    g = tl.load(grads + i, inside, 0.0)
    touched = g != 0
    at = tl.load(rows + i // channels, inside, 0) * channels + i % channels
    mean, square = tl.load(means + at, touched, 0.0), tl.load(squares + at, touched, 0.0)
    mean += (1 - beta1) * (g - mean)
    square = square * beta2 + (1 - beta2) * g * g
    step = rate * (mean / (tl.sqrt(square) / correction + eps))
    tl.store(means + at, mean, touched)
    tl.store(squares + at, square, touched)
    tl.store(params + at, tl.load(params + at, touched, 0.0) - step, touched)


def adam_rows(
    param: Float[Tensor, "T C"],
    mean: Float[Tensor, "T C"],
    square: Float[Tensor, "T C"],
    rows: Int[Tensor, "U"],
    grad: Float[Tensor, "U C"],
    constants: tuple[float, float, float, float, float],
) -> None:
    """Updates distinct rows in place.

    Args:
        param, mean, square: the table and its moments.
        rows: which rows, each once.
        grad: their gradients.
        constants: beta1, beta2, root of the second moment's correction, eps, and rate with the first one's.
    """
    if grad.numel():
        adam_kernel[(triton.cdiv(grad.numel(), 1024),)](
            rows.contiguous(), grad.contiguous(), param, mean, square, grad.numel(), param.shape[1], *constants,
            BLOCK=1024,
        )  # fmt: skip


# Total variation ----------------------------------------------------------------------------------------------------


@triton.jit
def variation_kernel(
    rows, values, table, grids, scales, gradient, totals, count, channels,
    NUM_HEADS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Huber loss of the differences of texels with their neighbours, which are held fixed, and its gradient."""
    i, c = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)
    inside, is_channel = i < count, (c < channels)[None, :]
    head, plane, y, x, inside = place_of(grids, tl.load(rows + i, inside, 0), inside, NUM_HEADS)
    grid = grids + head * INTS
    own = tl.load(values + i[:, None] * channels + c[None, :], inside[:, None] & is_channel, 0.0)
    slope, total = own * 0, own * 0
    for way in tl.static_range(6):
        axis, side = way // 2, way % 2 * 2 - 1
        nx, ny, nz = x + (side if axis == 0 else 0), y + (side if axis == 1 else 0), plane + (side if axis == 2 else 0)
        exists = inside & (nx >= 0) & (nx < tl.load(grid + WIDTH)) & (ny >= 0) & (ny < tl.load(grid + HEIGHT))
        exists = exists & (nz >= 0) & (nz < tl.load(grid + DEPTH))
        row = row_of(grids, head, nz, ny, nx, exists)
        exists = (exists & is_stored(row))[:, None] & is_channel
        difference = tl.where(exists, own - tl.load(table + row[:, None] * channels + c[None, :], exists, 0.0), 0.0)
        size, scale = tl.abs(difference), tl.load(scales + 3 * head + axis)[:, None] / 6
        slope += scale * tl.minimum(tl.maximum(difference, -1.0), 1.0)
        total += scale * tl.where(size <= 1, 0.5 * difference * difference, size - 0.5)
    tl.store(gradient + i[:, None] * channels + c[None, :], slope, (i < count)[:, None] & is_channel)
    tl.store(totals + tl.program_id(0), tl.sum(tl.sum(total, 1), 0))


class Variation(torch.autograd.Function):
    """``total_variation_reference``: value and gradient in one pass."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, table: Tensor, rows: Tensor, layout: Tensor, scales: Tensor) -> Tensor:
        count, channels = values.shape
        block = block_size(ROWS, values.device)
        gradient, programs = torch.empty_like(values), triton.cdiv(count, block)
        totals = torch.zeros(max(1, programs), device=values.device)
        if count:
            variation_kernel[(programs,)](
                rows.contiguous(), values.contiguous(), table, layout, scales, gradient, totals, count, channels,
                NUM_HEADS=len(scales), CHANNELS=triton.next_power_of_2(channels), BLOCK=block,
            )  # fmt: skip
        ctx.save_for_backward(gradient)
        return totals.sum()

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.saved_tensors[0] * grad_outputs[0], None, None, None, None
