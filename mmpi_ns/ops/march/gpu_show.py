"""Sums over what each ray kept, for pictures, where the march has written it."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import triton
import triton.language as tl

from mmpi_ns.ops import ends
from mmpi_ns.ops.gather.gpu import activate
from mmpi_ns.ops.gpu_scene import DEPTH, HEIGHT, INTS, WIDTH, cell, one_minus_exp, row_of

HALF = tl.constexpr(ends.HALF)

NUMBERS = 256
"""Rays of a program times their channels: what its registers hold."""


@triton.jit
def _read(table, grids, head, plane, place, known, channels, column, num_mpis, HAS_CUBE: tl.constexpr):
    """Interpolated texels of samples."""
    grid, z = grids + head * INTS, plane.to(tl.int64)
    x, fx = cell(tl.load(place, known, 0.0), tl.load(grid + WIDTH))
    y, fy = cell(tl.load(place + 1, known, 0.0), tl.load(grid + HEIGHT))
    in_cube, fz = head >= num_mpis, fx * 0
    if HAS_CUBE:
        lower, fraction = cell(tl.load(place + 2, known, 0.0), tl.load(grid + DEPTH))
        z, fz = tl.where(in_cube, lower, z), tl.where(in_cube, fraction, 0.0)
    raw = fx[:, None] * column * 0.0
    for tap in tl.static_range(8 if HAS_CUBE else 4):
        dx, dy, dz = tap % 2, tap // 2 % 2, tap // 4
        share = (fx if dx else 1 - fx) * (fy if dy else 1 - fy) * (fz if dz else 1 - fz)
        reads = known & (in_cube | (dz == 0))
        row = row_of(grids, head, z + dz, y + dy, x + dx, reads)
        read = tl.load(table + row[:, None] * channels + column, reads[:, None] & (column < channels), 0.0)
        raw += tl.where(reads, share, 0.0)[:, None] * read
    return raw


@triton.jit
def _weigh(taus, befores, slot, known, depth):
    """Weights of samples behind so much optical depth, and the depth behind them."""
    tau = tl.load(taus + slot, known, 0.0)
    light = tl.exp(-(depth + tl.load(befores + slot, known, 0.0)))
    return tl.where(known, light * one_minus_exp(tau), 0.0), depth + tau


@triton.jit(do_not_specialize=("num_rays", "room"))
def show_kernel(
    kept, heads, planes, places, inverse_ts, taus, befores, skipped, table, grids,
    gathered, masses, depths, medians, winners, num_rays, room, channels, num_mpis,
    HAS_CUBE: tl.constexpr, HEADS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums over what rays kept; a lane a ray."""
    ray, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)[None, :]
    inside, head_of = ray < num_rays, tl.arange(0, HEADS)[None, :]
    count, start = tl.load(kept + ray, inside, 0), ray.to(tl.int64) * room
    most = tl.max(count, 0)
    depth, mass = ray * 0.0, ray * 0.0
    total, of_heads = mass[:, None] * column, mass[:, None] * head_of
    for s in range(most):
        slot, known = start + s, s < count
        weight, depth = _weigh(taus, befores, slot, known, depth)
        head, plane = tl.load(heads + slot, known, 0), tl.load(planes + slot, known, 0)
        raw = _read(table, grids, head, plane, places + 3 * slot, known, channels, column, num_mpis, HAS_CUBE)
        total += weight[:, None] * activate(raw, column)
        of_heads += tl.where(head[:, None] == head_of, weight[:, None], 0.0)
        mass += weight
    tl.store(gathered + ray[:, None] * channels + column, total, inside[:, None] & (column < channels))
    tl.store(masses + ray, mass, inside)
    tl.store(depths + ray, depth + tl.load(skipped + ray, inside, 0.0), inside)
    tl.store(winners + ray, tl.argmax(of_heads, 1).to(tl.float32), inside)
    depth, passed, median = depth * 0, mass * 0, mass * 0
    waits = mass > 0
    for s in range(most):
        slot, known = start + s, s < count
        weight, depth = _weigh(taus, befores, slot, known, depth)
        passed += weight
        here = waits & known & (passed >= HALF * mass)
        median = tl.where(here, tl.load(inverse_ts + slot, known, 0.0), median)
        waits = waits & (passed < HALF * mass)
    tl.store(medians + ray, median, inside)
