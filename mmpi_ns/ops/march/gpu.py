"""All heads of a ray at once, front to back, to the samples that matter: the sampler's inner loop on a GPU.

The reference is ``reference.march``, the CPU's counterpart ``march.cpp``. A program marches a few rays
side by side. Which samples come next is arithmetic alone (every head's planes come near to far, so the nearest of the
heads' next ones is taken), so a chunk of samples is chosen first and then looked up at once: its loads do not wait for
each other. A ray ends where less than 1e-5 of its light is left, and less than a sample must weigh to be kept.
"""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops import ends
from mmpi_ns.ops.gather.gpu import sizes
from mmpi_ns.ops.gpu_scene import (
    BIAS,
    DEPTH,
    END,
    FLOATS,
    INTERVAL,
    INTS,
    S_SCALE,
    SHARE,
    STEP,
    U0,
    U_SCALE,
    V0,
    V_SCALE,
    GpuScene,
    bilinear,
    block_size,
    is_held,
    launch,
    minus_log_of_rest,
    nearest_row,
    one_minus_exp,
    softplus,
    trilinear,
)
from mmpi_ns.ops.layout import SceneLayout, Tables, shaped
from mmpi_ns.ops.march.gpu_hits import plane_hits
from mmpi_ns.ops.march.gpu_show import show_kernel
from mmpi_ns.ops.march.rays import MarchOptions, MergedSamples, Rays, Shown
from mmpi_ns.ops.march.reference import crossings

OPAQUE = tl.constexpr(ends.OPAQUE)
NEGLIGIBLE = tl.constexpr(ends.NEGLIGIBLE)
NEAREST_ZERO = tl.constexpr(ends.NEAREST_ZERO)
ULPS = tl.constexpr(16 * 2.0**-23)
"""Slack of the border test, as in ``geometry.local_to_ndc``."""
STEPS = 8
"""Samples that a ray looks up at once."""
RAYS, FEW_RAYS, MANY = 16, 4, 16_384
"""Rays of a program (one warp); of one where there are few rays; number of rays from which they are many. A device has
room for thousands of programs."""
NUMBERS = 256
"""Rays of a program of ``show_kernel`` times their channels: what its registers hold."""


@triton.jit
def _numbers(first, done, K: tl.constexpr, HEADS: tl.constexpr):
    """m of each head's next plane, or number of the cube's next sample."""
    is_mpi = (tl.arange(0, HEADS) < K)[None, :]
    return tl.where(is_mpi, first - done, first + done)


@triton.jit
def _next_distances(first, count, done, oz, dz, constants, cube, K: tl.constexpr, HEADS: tl.constexpr,
                    HAS_CUBE: tl.constexpr):  # fmt: skip
    """1/t of each head's next sample; -1 where it has none left."""
    head = tl.arange(0, HEADS)
    is_mpi = head < K
    number = _numbers(first, done, K, HEADS).to(tl.float32)
    step = tl.load(constants + head * FLOATS + STEP, is_mpi, 0.0)[None, :]
    w = number * step + tl.load(constants + head * FLOATS + END, is_mpi, 0.0)[None, :]
    inverse_t = w * dz / (1 - w * oz)
    if HAS_CUBE:
        in_cube = 1 / ((tl.maximum(number, 0.0) + 0.5) * tl.load(cube + 6))
        inverse_t = tl.where(is_mpi[None, :], inverse_t, in_cube)
    return tl.where(done < count, inverse_t, -1.0)


@triton.jit
def _choose(first, count, done, oz, dz, constants, cube, K: tl.constexpr, HEADS: tl.constexpr, HAS_CUBE: tl.constexpr,
            RAYS: tl.constexpr, STEPS: tl.constexpr):  # fmt: skip
    """The next samples of each ray in the order of distance: head, number, 1/t (-1: none). Equal ones by head."""
    column, head = tl.arange(0, STEPS)[None, :], tl.arange(0, HEADS)[None, :]
    heads, numbers = tl.zeros([RAYS, STEPS], tl.int32), tl.zeros([RAYS, STEPS], tl.int32)
    inverse_ts = tl.full([RAYS, STEPS], -1.0, tl.float32)
    for i in tl.static_range(STEPS):
        distances = _next_distances(first, count, done, oz, dz, constants, cube, K, HEADS, HAS_CUBE)
        top, best = tl.max(distances, 1, return_indices=True)
        is_best = (head == best[:, None]) & (done < count)
        number = tl.sum(tl.where(is_best, _numbers(first, done, K, HEADS), 0), 1)
        here = column == i
        heads = tl.where(here, best[:, None].to(tl.int32), heads)
        numbers = tl.where(here, number[:, None], numbers)
        inverse_ts = tl.where(here, top[:, None], inverse_ts)
        done += is_best.to(tl.int32)
    return heads, numbers, inverse_ts, done


@triton.jit
def _on_plane(us, vs, constants, ray, mpi, number, wanted, K: tl.constexpr):
    """Disparity, u and v of planes of MPIs where rays cross them."""
    row, at = constants + mpi * FLOATS, 2 * (ray[:, None] * K + mpi)
    w = number.to(tl.float32) * tl.load(row + STEP, wanted, 0.0) + tl.load(row + END, wanted, 0.0)
    u = tl.load(us + at, wanted, 0.0) + w * tl.load(us + at + 1, wanted, 0.0)
    v = tl.load(vs + at, wanted, 0.0) + w * tl.load(vs + at + 1, wanted, 0.0)
    u = (u - tl.load(row + U0, wanted, 0.0)) * tl.load(row + U_SCALE, wanted, 0.0) - 1
    return w, u, (v - tl.load(row + V0, wanted, 0.0)) * tl.load(row + V_SCALE, wanted, 0.0) - 1


@triton.jit
def _pass_empty(us, vs, constants, grids, ray, first, count, K: tl.constexpr, HEADS: tl.constexpr):
    """How many of each MPI's nearest planes hold nothing where the ray crosses them."""
    head = tl.arange(0, HEADS)[None, :]
    passed, passes = count * 0, (head < K) & (count > 0)
    mpi = tl.where(head < K, head, 0) + count * 0
    while tl.max(tl.max(passes.to(tl.int32), 1), 0) > 0:
        number = first - passed
        _, u, v = _on_plane(us, vs, constants, ray, mpi, number, passes, K)
        plane = tl.load(grids + mpi * INTS + DEPTH, passes, 0).to(tl.int32) - 1 - number
        passes = passes & ~is_held(grids, mpi, plane, u, v, passes)
        passed += passes.to(tl.int32)
        passes = passes & (passed < count)
    return passed


@triton.jit
def _look_up(origins, directions, us, vs, constants, grids, biases, cube, density, ray, head, number, wanted,
             K: tl.constexpr, HAS_CUBE: tl.constexpr):  # fmt: skip
    """Plane, NDC and optical depth of samples."""
    is_mpi = head < K
    own, in_mpi = tl.where(is_mpi, head, 0), wanted & is_mpi
    row = constants + own * FLOATS
    w, u, v = _on_plane(us, vs, constants, ray, own, number, in_mpi, K)
    s = 1 - tl.load(row + S_SCALE) * (w - tl.load(row + END))
    plane = tl.load(grids + own * INTS + DEPTH).to(tl.int32) - 1 - number
    raw = bilinear(density, grids, own, plane, u, v, in_mpi)
    raw += tl.load(biases + tl.load(grids + own * INTS + BIAS) + plane, in_mpi, 0.0)
    tau = softplus(raw) * tl.load(row + INTERVAL)
    if HAS_CUBE:
        in_cube = wanted & (head == K)
        t = (tl.where(in_cube, number, 0).to(tl.float32) + 0.5) * tl.load(cube + 6)
        x, y, z = _in_cube(origins, directions, cube, ray, t)
        thick = softplus(trilinear(density, grids, K, x, y, z, in_cube) + tl.load(cube + 7))
        tau = tl.where(is_mpi, tau, thick * tl.load(cube + 8))
        u, v, s = tl.where(is_mpi, u, x), tl.where(is_mpi, v, y), tl.where(is_mpi, s, z)
        plane = tl.where(is_mpi, plane, number)
    return plane, u, v, s, tau


@triton.jit
def _in_cube(origins, directions, cube, ray, t):
    """Points in the cube at distances t, normalised to [-1, 1]^3."""
    at = 3 * ray[:, None]
    x = tl.load(origins + at) + tl.load(directions + at) * t
    y = tl.load(origins + at + 1) + tl.load(directions + at + 1) * t
    z = tl.load(origins + at + 2) + tl.load(directions + at + 2) * t
    x = 2 * (x - tl.load(cube)) / tl.load(cube + 3) - 1
    y = 2 * (y - tl.load(cube + 1)) / tl.load(cube + 4) - 1
    return x, y, 2 * (z - tl.load(cube + 2)) / tl.load(cube + 5) - 1


@triton.jit
def _in_mpi(local_origins, local_directions, constants, ray, k, inverse_t, K: tl.constexpr):
    """Where samples lie in MPI k, and whether inside its frustum."""
    at, mpi = 3 * (ray[:, None] * K + k), constants + k * FLOATS
    origin, direction = local_origins + at, local_directions + at
    z = tl.load(origin + 2) * inverse_t + tl.load(direction + 2)
    ahead = z > 0
    depth = tl.where(ahead, z, 1.0)
    u = ((tl.load(origin) * inverse_t + tl.load(direction)) / depth - tl.load(mpi + U0)) * tl.load(mpi + U_SCALE) - 1
    v = (tl.load(origin + 1) * inverse_t + tl.load(direction + 1)) / depth - tl.load(mpi + V0)
    v = v * tl.load(mpi + V_SCALE) - 1
    s = 1 - tl.load(mpi + S_SCALE) * (inverse_t / depth - tl.load(mpi + END))
    inside = ahead & (tl.abs(u) <= 1 + ULPS) & (tl.abs(v) <= 1 + ULPS) & (tl.abs(s) <= 1 + ULPS / tl.load(mpi + SHARE))
    return tl.where(ahead, u, 0.0), tl.where(ahead, v, 0.0), tl.where(ahead, s, 0.0), inside


@triton.jit
def _count_vote(own_vote, highest, others, grids, reliability, touched, k, head, u, v, s, inside, thick):
    """Adds head k's vote on samples: (own vote, highest of the others, sum of e^(other - highest))."""
    is_own = head == k
    asked = thick & (inside | is_own)
    vote = trilinear(reliability, grids, k, u, v, s, asked)
    counts = asked & (head != k)
    counts = counts & (tl.load(touched + nearest_row(grids, k, u, v, s, counts), counts, 0) > 0)
    higher = tl.where(counts, tl.maximum(highest, vote), highest)
    # -1e30 instead of -infinity: differences of it are numbers.
    others = tl.where(counts, others * tl.exp(highest - higher) + tl.exp(vote - higher), others)
    return tl.where(is_own, vote, own_vote), higher, others


@triton.jit
def _blend(origins, directions, local_origins, local_directions, constants, grids, cube, reliability, touched,
           ray, head, inverse_t, tau, wanted, K: tl.constexpr, HAS_CUBE: tl.constexpr):  # fmt: skip
    """Optical depths after blending (``blending.blend_shares`` and ``blended_optical_depth``)."""
    thick = wanted & (tau > NEGLIGIBLE)
    own_vote, highest, others = tau * 0, tau * 0 - 1e30, tau * 0
    for k in range(K):
        u, v, s, inside = _in_mpi(local_origins, local_directions, constants, ray, k, inverse_t, K)
        own_vote, highest, others = _count_vote(
            own_vote, highest, others, grids, reliability, touched, k, head, u, v, s, inside, thick
        )
    if HAS_CUBE:
        x, y, z = _in_cube(origins, directions, cube, ray, 1 / tl.maximum(inverse_t, NEAREST_ZERO))
        inside = (inverse_t > 0) & (tl.abs(x) <= 1) & (tl.abs(y) <= 1) & (tl.abs(z) <= 1)
        own_vote, highest, others = _count_vote(
            own_vote, highest, others, grids, reliability, touched, K, head, x, y, z, inside, thick
        )
    sole = others == 0
    odds = tl.where(sole, 0.0, highest - own_vote + tl.log(tl.where(sole, 1.0, others)))
    log_share, log_rest = -softplus(odds), -softplus(-odds)
    alpha, lower = one_minus_exp(tau) * tl.exp(log_share), log_share - tau
    opaque = tl.maximum(log_rest, lower) + softplus(-tl.abs(log_rest - lower))
    blended = tl.where(alpha < 0.5, minus_log_of_rest(tl.minimum(alpha, 0.5)), tl.maximum(-opaque, 0.0))
    blended = tl.where(sole, tau, blended)
    return tl.where(thick, blended, tau / (K + HAS_CUBE))


@triton.jit
def _before(values, STEPS: tl.constexpr):
    """Sum of the earlier columns. Summed, not subtracted: x - x loses what came before a large x."""
    i = tl.arange(0, STEPS)
    earlier = (i[:, None] > i[None, :])[None, :, :]
    return tl.sum(tl.where(earlier, values[:, None, :], 0), 2)


@triton.jit(do_not_specialize=("num_rays", "room"))
def march_kernel(
    origins, directions, local_origins, local_directions, us, vs, firsts, counts,
    constants, grids, biases, cube, density, reliability, touched,
    kept, skipped_total, dropped_mass, heads, planes, ndc, inverse_ts, taus, skipped_before, numbers,
    num_rays, room, threshold, fair_share,
    K: tl.constexpr, HEADS: tl.constexpr, HAS_CUBE: tl.constexpr, BLENDS: tl.constexpr,
    KEEP_ALL: tl.constexpr, RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    """Marches RAYS rays. What ray r keeps is written from r * room on; how much, to kept[r]. ``numbers``: the most that
    a ray keeps, then what is kept of each head."""
    row = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    exists = row < num_rays
    ray, head_of = tl.where(exists, row, 0), tl.arange(0, HEADS)
    at = ray[:, None] * (K + HAS_CUBE) + head_of[None, :]
    has = exists[:, None] & (head_of < K + HAS_CUBE)[None, :]
    first, count = tl.load(firsts + at, has, 0).to(tl.int32), tl.load(counts + at, has, 0).to(tl.int32)
    local_z, in_mpi = 3 * (ray[:, None] * K + head_of[None, :]) + 2, (head_of < K)[None, :]
    oz, dz = tl.load(local_origins + local_z, in_mpi, 0.0), tl.load(local_directions + local_z, in_mpi, 0.0)
    left = tl.sum(count, 1)
    bound = tl.minimum(fair_share / tl.maximum(left, 1).to(tl.float32), threshold)
    end_of_light = tl.minimum(bound, OPAQUE)
    done = count * 0
    if KEEP_ALL:
        bound, end_of_light = bound * 0 - 1, bound * 0 - 1
    else:
        done = _pass_empty(us, vs, constants, grids, ray, first, count, K, HEADS)
        left -= tl.sum(done, 1)
    number_kept, of_heads = left * 0, head_of * 0
    depth, skipped, dropped = bound * 0, bound * 0, bound * 0
    while tl.max(left, 0) > 0:
        head, number, inverse_t, done = _choose(
            first, count, done, oz, dz, constants, cube, K, HEADS, HAS_CUBE, RAYS, STEPS
        )
        met = (inverse_t >= 0) & (left > 0)[:, None]
        plane, u, v, s, tau = _look_up(
            origins, directions, us, vs, constants, grids, biases, cube, density, ray, head, number, met, K, HAS_CUBE
        )
        if BLENDS:
            tau = _blend(
                origins, directions, local_origins, local_directions, constants, grids, cube, reliability, touched,
                ray, head, inverse_t, tau, met, K, HAS_CUBE,
            )  # fmt: skip
        tau = tl.where(met, tau, 0.0)
        light = tl.exp(-(depth[:, None] + _before(tau, STEPS)))
        seen = met & (light > end_of_light[:, None])
        weight = light * one_minus_exp(tau)
        keep = seen & (weight > bound[:, None])
        skip = tl.where(seen & (weight <= bound[:, None]), tau, 0.0)
        slot = number_kept[:, None] + _before(keep.to(tl.int32), STEPS)
        keep = keep & (slot < room)
        to = ray[:, None].to(tl.int64) * room + slot
        tl.store(heads + to, head, keep)
        tl.store(planes + to, plane, keep)
        tl.store(ndc + 3 * to, u, keep)
        tl.store(ndc + 3 * to + 1, v, keep)
        tl.store(ndc + 3 * to + 2, s, keep)
        tl.store(inverse_ts + to, inverse_t, keep)
        tl.store(taus + to, tau, keep)
        tl.store(skipped_before + to, skipped[:, None] + _before(skip, STEPS), keep)
        number_kept += tl.sum(keep.to(tl.int32), 1)
        for k in range(K + HAS_CUBE):
            own = tl.sum(tl.sum((keep & (head == k)).to(tl.int32), 1), 0)
            of_heads += tl.where(head_of == k, own, 0)
        skipped += tl.sum(skip, 1)
        dropped += tl.sum(tl.where(skip > 0, weight, 0.0), 1)
        depth += tl.sum(tl.where(seen, tau, 0.0), 1)
        # Where a ray ends early, the light left there is no less than what all the rest weighs.
        unseen = tl.max(tl.where(met & (light <= end_of_light[:, None]), light, -1.0), 1)
        left = tl.where(unseen >= 0, 0, left - STEPS)  # by rounds, so that no odd number can keep the loop going
        ends = (left > 0) & (tl.exp(-depth) <= end_of_light)
        dropped += tl.where(unseen >= 0, unseen, tl.where(ends, tl.exp(-depth), 0.0))
        left = tl.where(ends, 0, left)
    tl.store(kept + row, number_kept, exists)
    tl.store(skipped_total + row, skipped, exists)
    tl.store(dropped_mass + row, dropped, exists)
    tl.atomic_max(numbers, tl.max(number_kept, 0), sem="relaxed")
    tl.atomic_add(numbers + 1 + head_of, of_heads, head_of < K + HAS_CUBE, sem="relaxed")


@triton.jit(do_not_specialize=("size", "width", "room"))
def pack_kernel(
    kept, heads, planes, ndc, inverse_ts, taus, skipped_before,
    to_heads, to_planes, to_ndc, to_inverse_ts, to_taus, to_skipped_before, valid,
    size, width, room, BLOCK: tl.constexpr,
):  # fmt: skip
    """Copies what the rays kept into ``width`` slots each; the rest of the slots is 0."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    ray, slot = i // width, i % width
    has = inside & (slot < tl.load(kept + ray, inside, 0))
    at = ray * room + slot
    tl.store(valid + i, has, inside)
    tl.store(to_heads + i, tl.load(heads + at, has, 0).to(tl.int64), inside)
    tl.store(to_planes + i, tl.load(planes + at, has, 0).to(tl.int64), inside)
    for a in tl.static_range(3):
        tl.store(to_ndc + 3 * i + a, tl.load(ndc + 3 * at + a, has, 0.0), inside)
    tl.store(to_inverse_ts + i, tl.load(inverse_ts + at, has, 0.0), inside)
    tl.store(to_taus + i, tl.load(taus + at, has, 0.0), inside)
    tl.store(to_skipped_before + i, tl.load(skipped_before + at, has, 0.0), inside)


@dataclass(frozen=True)
class Slots:
    """What rays kept, each in ``room`` slots of its own."""

    kept: Int[Tensor, "R"]
    """So many; what the other slots hold means nothing."""
    slots: list[Tensor]
    """Heads, planes, NDC, inverse distances, optical depths, and optical depths skipped before: each [R, room, .]."""
    room: int
    skipped_total: Float[Tensor, "R 1"]
    dropped_mass: Float[Tensor, "R 1"]
    live: Int[Tensor, "R"]
    explained: Bool[Tensor, "R 1"]
    numbers: Int[Tensor, "1+H"]
    """The most that a ray kept, then what was kept of each head."""


def march_into_slots(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> Slots:
    """``march`` before anything is waited for."""
    origins, directions, hits, first, counts, explained = crossings(layout, rays, plane_hits(layout, rays))
    scene, device, num_rays, threshold = GpuScene.of(layout), origins.device, len(origins), float(options.threshold)
    parts = (origins, directions, hits.local_origins, hits.local_directions, hits.u, hits.v, first, counts)
    room = options.most_kept(layout.most_samples)
    kept = torch.empty(num_rays, dtype=torch.int32, device=device)
    skipped, dropped = (torch.empty(num_rays, 1, device=device) for _ in range(2))
    slots = [torch.empty(num_rays, room, dtype=torch.int32, device=device) for _ in range(2)]
    slots += [torch.empty(num_rays, room, width, device=device) for width in (3, 1, 1, 1)]
    numbers = torch.zeros(1 + layout.num_heads, dtype=torch.int32, device=device)
    at_once = block_size(RAYS if num_rays >= MANY else FEW_RAYS, device)
    launch(
        march_kernel, num_rays, at_once, *(x.contiguous() for x in parts), *scene.constants(), *scene.checked(tables),
        kept, skipped, dropped, *slots, numbers, num_rays, room, threshold, float(options.fair_share),
        K=len(layout.mpis), HEADS=triton.next_power_of_2(layout.num_heads), HAS_CUBE=layout.cube is not None,
        BLENDS=options.blends, KEEP_ALL=threshold <= 0, RAYS=at_once, STEPS=STEPS,
        num_warps=1,
    )  # fmt: skip
    return Slots(kept, slots, room, skipped, dropped, counts.sum(-1), explained, numbers)


def march(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> MergedSamples:
    """See ``ops.march``. Waits for the device once, to size the result."""
    m = march_into_slots(layout, tables, rays, options)
    widest, *of_heads = m.numbers.tolist()
    num_rays, width = len(m.kept), max(1, widest)
    shapes = [(num_rays, width, 3) if i == 2 else (num_rays, width) for i in range(7)]
    types = (torch.int64, torch.int64, *[torch.float32] * 4, torch.bool)
    packed = [torch.empty(shape, dtype=t, device=m.kept.device) for shape, t in zip(shapes, types, strict=True)]
    size = num_rays * width
    launch(pack_kernel, size, 1024, m.kept, *m.slots, *packed, size, width, m.room, BLOCK=1024)
    left = {"skipped_total": m.skipped_total, "dropped_mass": m.dropped_mass}
    return MergedSamples(*packed, **left, live=m.live, explained=m.explained, head_counts=tuple(of_heads))


def show_rays(layout: SceneLayout, tables: Tables, features: Tensor, rays: Rays, options: MarchOptions) -> Shown:
    """See ``ops.march``. Nothing is packed, and the host need not know how much any ray kept."""
    m = march_into_slots(layout, tables, rays, options)
    num_rays, channels, device = len(rays.origins), features.shape[1], features.device
    gathered = torch.empty(num_rays, channels, device=device)
    mass, depth, median, winner = (torch.empty(num_rays, 1, device=device) for _ in range(4))
    columns, block = sizes(channels, device, NUMBERS)
    launch(
        show_kernel, num_rays, block, m.kept, *m.slots, m.skipped_total, shaped(features, layout.num_rows, channels),
        GpuScene.of(layout).grids, gathered, mass, depth, median, winner, num_rays, m.room, channels, len(layout.mpis),
        HAS_CUBE=layout.cube is not None, HEADS=triton.next_power_of_2(layout.num_heads), CHANNELS=columns, BLOCK=block,
    )  # fmt: skip
    return Shown(gathered, mass, torch.exp(-depth), -torch.expm1(-depth), median, winner, m.dropped_mass)
