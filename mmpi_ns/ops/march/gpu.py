"""March of rays through all heads, front to back: kept samples for training, and their sums for images.

The CPU's counterparts are ``march.cpp`` and ``render.cpp``. A program marches a few rays side by side (``gpu_walk.py``)
and writes kept samples to slots, which are packed for training, or summed for images. A ray terminates where its
transmittance falls below 1e-5 and below the weight that a sample must have to be kept.
"""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops import ends
from mmpi_ns.ops.gather.gpu import activate, sizes
from mmpi_ns.ops.gpu_scene import (
    DEPTH,
    HEIGHT,
    INTS,
    WIDTH,
    block_size,
    cell,
    grids_of,
    launch,
    one_minus_exp,
    row_of,
    vectors,
)
from mmpi_ns.ops.layout import SceneLayout, Tables, dense, dense_fields
from mmpi_ns.ops.march import MarchOptions, MergedSamples, RayOutputs, Rays, empty_samples
from mmpi_ns.ops.march.gpu_walk import before, cross, next_samples, pass_empty

OPAQUE = tl.constexpr(ends.OPAQUE)
HALF = tl.constexpr(ends.HALF)
STEPS, PACKED = 8, 32
"""Samples of a ray per chunk of lookups, and of those that are packed."""
RAYS = 4
"""Rays per program (one warp). Four times as many are no faster, and take minutes to compile."""
RANGES = 256
"""Rays per program times their heads, with nine numbers for each: twice as many do not fit the registers."""
NUMBERS = 256
"""Rays per program of ``render_kernel`` times their channels, limited by its registers."""


@triton.jit
def _store_samples(
    keep, ray, number_kept, room, head, plane, u, v, s, inverse_t, tau, skipped,
    heads, planes, ndc, inverse_ts, taus, skipped_before, STEPS: tl.constexpr,
):  # fmt: skip
    """Writes kept samples to the next slots of their rays. Returns which of them had room."""
    slot = number_kept[:, None] + before(keep.to(tl.int32), STEPS)
    keep = keep & (slot < room)
    to = ray[:, None].to(tl.int64) * room + slot
    tl.store(heads + to, head, keep)
    tl.store(planes + to, plane, keep)
    tl.store(ndc + 3 * to, u, keep)
    tl.store(ndc + 3 * to + 1, v, keep)
    tl.store(ndc + 3 * to + 2, s, keep)
    tl.store(inverse_ts + to, inverse_t, keep)
    tl.store(taus + to, tau, keep)
    tl.store(skipped_before + to, skipped, keep)
    return keep


@triton.jit
def _bounds(samples, threshold, fair_share, KEEP_ALL: tl.constexpr):
    """Weight that a kept sample exceeds, and transmittance at which a ray terminates (``Bounds`` of cpp/walk.h)."""
    bound = tl.minimum(fair_share / tl.maximum(samples, 1).to(tl.float32), threshold)
    bound = bound * 0 - 1 if KEEP_ALL else bound
    return bound, tl.minimum(bound, OPAQUE)


@triton.jit
def _ends(remaining, met, transmittance, depth, least_transmittance, STEPS: tl.constexpr):
    """Number of samples that remain after a chunk, and the transmittance of rays that terminate early, which bounds
    the weight of all that remains."""
    unseen = tl.max(tl.where(met & (transmittance <= least_transmittance[:, None]), transmittance, -1.0), 1)
    remaining = tl.where(unseen >= 0, 0, remaining - STEPS)  # by rounds, so that no odd number can keep the loop going
    terminated = (remaining > 0) & (tl.exp(-depth) <= least_transmittance)
    return tl.where(terminated, 0, remaining), tl.where(unseen >= 0, unseen, tl.where(terminated, tl.exp(-depth), 0.0))


@triton.jit(do_not_specialize=("num_rays", "room"))
def march_kernel(
    origins, directions, nears, fars, allowed, priorities, constants, grids, biases, cube, density, reliability,
    touched, num_intersected, fully_covered, kept, skipped_total, dropped_mass, heads, planes, ndc, inverse_ts, taus,
    skipped_before, numbers, num_rays, room, threshold, fair_share, content_near, K: tl.constexpr, HEADS: tl.constexpr,
    HAS_CUBE: tl.constexpr, ALLOWS: tl.constexpr, CHOOSES: tl.constexpr, BLENDS: tl.constexpr, KEEP_ALL: tl.constexpr,
    RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    """Kept samples of ray r, written from r * room on. ``numbers``: those of each head."""
    row, head_of = tl.program_id(0) * RAYS + tl.arange(0, RAYS), tl.arange(0, HEADS)
    exists = row < num_rays
    ray = tl.where(exists, row, 0)
    x, y, z = vectors(origins, ray[:, None])
    dx, dy, dz = vectors(directions, ray[:, None])
    first, count, u, bend_u, v, bend_v, local_z, local_dz, is_fully_covered = cross(
        ray, exists, x, y, z, dx, dy, dz, nears, fars, allowed, priorities, constants, cube, content_near,
        K, HEADS, HAS_CUBE, ALLOWS, CHOOSES,
    )  # fmt: skip
    remaining, done = tl.sum(count, 1), count * 0
    tl.store(num_intersected + row, remaining.to(tl.int64), exists)
    tl.store(fully_covered + row, is_fully_covered, exists)
    if not KEEP_ALL:
        done = pass_empty(first, count, u, bend_u, v, bend_v, constants, grids, K, HEADS)
    bound, least_transmittance = _bounds(remaining, threshold, fair_share, KEEP_ALL)
    remaining -= tl.sum(done, 1)
    number_kept, of_heads, depth, skipped, dropped = remaining * 0, head_of * 0, bound * 0, bound * 0, bound * 0
    while tl.max(remaining, 0) > 0:
        met, head, plane, p, q, s, inverse_t, tau, done = next_samples(
            remaining > 0, first, count, done, u, bend_u, v, bend_v, local_z, local_dz, x, y, z, dx, dy, dz,
            constants, grids, biases, cube, density, reliability, touched, K, HEADS, HAS_CUBE, BLENDS, RAYS, STEPS,
        )  # fmt: skip
        transmittance = tl.exp(-(depth[:, None] + before(tau, STEPS)))
        seen, weight = met & (transmittance > least_transmittance[:, None]), transmittance * one_minus_exp(tau)
        keep, skip = seen & (weight > bound[:, None]), tl.where(seen & (weight <= bound[:, None]), tau, 0.0)
        keep = _store_samples(
            keep, ray, number_kept, room, head, plane, p, q, s, inverse_t, tau, skipped[:, None] + before(skip, STEPS),
            heads, planes, ndc, inverse_ts, taus, skipped_before, STEPS,
        )  # fmt: skip
        number_kept += tl.sum(keep.to(tl.int32), 1)
        for k in range(K + HAS_CUBE):
            of_heads += tl.where(head_of == k, tl.sum(tl.sum((keep & (head == k)).to(tl.int32), 1), 0), 0)
        skipped += tl.sum(skip, 1)
        dropped += tl.sum(tl.where(skip > 0, weight, 0.0), 1)
        depth += tl.sum(tl.where(seen, tau, 0.0), 1)
        remaining, rest = _ends(remaining, met, transmittance, depth, least_transmittance, STEPS)
        dropped += rest
    tl.store(kept + row, number_kept, exists)
    tl.store(skipped_total + row, skipped, exists)
    tl.store(dropped_mass + row, dropped, exists)
    tl.atomic_add(numbers + head_of, of_heads, head_of < K + HAS_CUBE, sem="relaxed")


@triton.jit
def _read(table, grids, head, plane, place, has, channels, column, num_mpis, HAS_CUBE: tl.constexpr):
    """Interpolated texels of samples."""
    grid, z = grids + head * INTS, plane.to(tl.int64)
    x, fx = cell(tl.load(place, has, 0.0), tl.load(grid + WIDTH))
    y, fy = cell(tl.load(place + 1, has, 0.0), tl.load(grid + HEIGHT))
    in_cube, fz = head >= num_mpis, fx * 0
    if HAS_CUBE:
        lower, fraction = cell(tl.load(place + 2, has, 0.0), tl.load(grid + DEPTH))
        z, fz = tl.where(in_cube, lower, z), tl.where(in_cube, fraction, 0.0)
    raw = fx[:, None] * column * 0.0
    for tap in tl.static_range(8 if HAS_CUBE else 4):
        dx, dy, dz = tap % 2, tap // 2 % 2, tap // 4
        share = (fx if dx else 1 - fx) * (fy if dy else 1 - fy) * (fz if dz else 1 - fz)
        reads = has & (in_cube | (dz == 0))
        row = row_of(grids, head, z + dz, y + dy, x + dx, reads)
        read = tl.load(table + row[:, None] * channels + column, reads[:, None] & (column < channels), 0.0)
        raw += tl.where(reads, share, 0.0)[:, None] * read
    return raw


@triton.jit
def _weigh(taus, befores, slot, has, depth):
    """Weights of samples behind a given optical depth, and the depth behind them."""
    tau = tl.load(taus + slot, has, 0.0)
    transmittance = tl.exp(-(depth + tl.load(befores + slot, has, 0.0)))
    return tl.where(has, transmittance * one_minus_exp(tau), 0.0), depth + tau


@triton.jit(do_not_specialize=("num_rays", "room"))
def render_kernel(
    kept, heads, planes, places, inverse_ts, taus, befores, skipped, table, grids,
    gathered, masses, depths, medians, winners, num_rays, room, channels, num_mpis,
    HAS_CUBE: tl.constexpr, HEADS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums over the kept samples of rays, one lane per ray."""
    ray, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)[None, :]
    inside, head_of = ray < num_rays, tl.arange(0, HEADS)[None, :]
    count, start = tl.load(kept + ray, inside, 0), ray.to(tl.int64) * room
    most = tl.max(count, 0)
    depth, mass = ray * 0.0, ray * 0.0
    total, of_heads = mass[:, None] * column, mass[:, None] * head_of
    for s in range(most):
        slot, has = start + s, s < count
        weight, depth = _weigh(taus, befores, slot, has, depth)
        head, plane = tl.load(heads + slot, has, 0), tl.load(planes + slot, has, 0)
        raw = _read(table, grids, head, plane, places + 3 * slot, has, channels, column, num_mpis, HAS_CUBE)
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
        slot, has = start + s, s < count
        weight, depth = _weigh(taus, befores, slot, has, depth)
        passed += weight
        here = waits & has & (passed >= mass * HALF)
        median = tl.where(here, tl.load(inverse_ts + slot, has, 0.0), median)
        waits = waits & (passed < mass * HALF)
    tl.store(medians + ray, median, inside)


class Slots(NamedTuple):
    """Kept samples of each ray in ``room`` slots, before any synchronisation."""

    kept: Int[Tensor, "R"]
    """Number of kept samples; the other slots are undefined."""
    samples: list[Tensor]
    """See ``empty_samples``; [R, room] each."""
    skipped_total: Float[Tensor, "R 1"]
    dropped_mass: Float[Tensor, "R 1"]
    num_intersected: Int[Tensor, "R"]
    fully_covered: Bool[Tensor, "R 1"]
    numbers: Int[Tensor, "H"]
    """Number of kept samples of each head."""


def march_into_slots(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> Slots:
    """``march`` up to the slots that are then packed or summed."""
    num_rays, num_heads, device = len(rays.origins), layout.num_heads, rays.origins.device
    threshold, room = float(options.threshold), options.most_kept(layout.most_samples)
    # If all heads may render, the placeholder of the choice is not read.
    parts = [rays.origins if x is None else x for x in dense_fields(rays)]
    m = Slots(
        kept=torch.empty(num_rays, dtype=torch.int32, device=device),
        samples=empty_samples(num_rays, room, index=torch.int32, device=device),
        skipped_total=torch.empty(num_rays, 1, device=device),
        dropped_mass=torch.empty(num_rays, 1, device=device),
        num_intersected=torch.empty(num_rays, dtype=torch.int64, device=device),
        fully_covered=torch.empty(num_rays, 1, dtype=torch.bool, device=device),
        numbers=torch.zeros(num_heads, dtype=torch.int32, device=device),
    )
    heads, (head_rows, biases, cube_row) = triton.next_power_of_2(num_heads), layout.constants
    at_once = block_size(max(1, min(RAYS, RANGES // heads)), device)
    launch(
        march_kernel, num_rays, at_once, *parts,
        head_rows, grids_of(layout), biases, cube_row, *dense_fields(tables),
        m.num_intersected, m.fully_covered, m.kept, m.skipped_total, m.dropped_mass, *m.samples, m.numbers,
        num_rays, room, threshold, float(options.fair_share), float(layout.content_near),
        K=len(layout.mpis), HEADS=heads, HAS_CUBE=layout.cube is not None,
        ALLOWS=rays.heads is not None, CHOOSES=rays.priorities is not None, BLENDS=options.blends,
        KEEP_ALL=threshold <= 0, RAYS=at_once, STEPS=STEPS, num_warps=1,
    )  # fmt: skip
    return m


@triton.jit(do_not_specialize=("num_rays", "room", "count"))
def pack_kernel(
    kept, starts, from_heads, from_planes, from_ndc, from_inverse_ts, from_taus, from_skipped,
    heads, planes, ndc, inverse_ts, taus, skipped, num_rays, room, count, RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    """Moves samples from the slots of their rays to one array."""
    ray = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    inside = ray < num_rays
    number, start = tl.load(kept + ray, inside, 0)[:, None], tl.load(starts + ray, inside, 0)[:, None]
    for first in range(0, tl.max(number), STEPS):
        step = first + tl.arange(0, STEPS)[None, :]
        slot, to = ray[:, None].to(tl.int64) * room + step, start + step
        has = (step < number) & (to < count)
        tl.store(heads + to, tl.load(from_heads + slot, has, 0).to(tl.int64), has)
        tl.store(planes + to, tl.load(from_planes + slot, has, 0).to(tl.int64), has)
        tl.store(inverse_ts + to, tl.load(from_inverse_ts + slot, has, 0.0), has)
        tl.store(taus + to, tl.load(from_taus + slot, has, 0.0), has)
        tl.store(skipped + to, tl.load(from_skipped + slot, has, 0.0), has)
        for axis in tl.static_range(3):
            tl.store(ndc + 3 * to + axis, tl.load(from_ndc + 3 * slot + axis, has, 0.0), has)


def march(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> MergedSamples:
    """``sampler.march`` on a GPU, which synchronises once, to size the result, unless a capacity is given."""
    m, capacity = march_into_slots(layout, tables, rays, options), options.capacity
    of_heads = tuple(m.numbers.tolist()) if capacity is None else capacity.heads
    count = sum(of_heads) if capacity is None else capacity.samples
    starts, device, room = pad(m.kept.cumsum(0), (1, 0)).clamp(max=count), m.kept.device, m.samples[0].shape[1]
    indices, values = torch.zeros(2, count, dtype=torch.int64, device=device), torch.zeros(6, count, device=device)
    flat = (*indices, values[:3].view(count, 3), *values[3:])
    block = block_size(RAYS, device)
    launch(
        pack_kernel, len(m.kept) if count else 0, block, m.kept, starts, *m.samples, *flat, len(m.kept), room, count,
        RAYS=block, STEPS=PACKED, num_warps=4,
    )  # fmt: skip
    numbers = torch.cat([m.numbers.sum(0, keepdim=True), m.numbers])
    of_rays = (m.skipped_total, m.dropped_mass, m.num_intersected, m.fully_covered, of_heads)
    return MergedSamples(*flat, starts, *of_rays, capacity, numbers)


def render_fused(
    layout: SceneLayout, tables: Tables, features: Tensor, rays: Rays, options: MarchOptions
) -> RayOutputs:
    """``sampler.render_fused`` on a GPU: sums over the slots, without packing or synchronisation."""
    m = march_into_slots(layout, tables, rays, options)
    num_rays, channels, device = len(rays.origins), features.shape[1], features.device
    gathered = torch.empty(num_rays, channels, device=device)
    mass, depth, median, winner = (torch.empty(num_rays, 1, device=device) for _ in range(4))
    columns, block, warps = sizes(channels, device, NUMBERS)
    launch(
        render_kernel, num_rays, block, m.kept, *m.samples, m.skipped_total, *dense(features),
        grids_of(layout), gathered, mass, depth, median, winner,
        num_rays, m.samples[0].shape[1], channels, len(layout.mpis),
        HAS_CUBE=layout.cube is not None, HEADS=triton.next_power_of_2(layout.num_heads), CHANNELS=columns, BLOCK=block,
        num_warps=warps,
    )  # fmt: skip
    return RayOutputs(gathered, mass, torch.exp(-depth), -torch.expm1(-depth), median, winner, m.dropped_mass)
