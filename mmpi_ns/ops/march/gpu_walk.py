"""A ray's walk through a scene on a GPU: which samples come next, what they hold, and their blending.

The counterpart of ``cpp/walk.h`` and ``cpp/blend.h``. Which samples come next is arithmetic alone: every head's planes
come near to far, and the nearest of the heads' next ones is taken. So a chunk of samples is chosen first and then
looked up at once, and its loads do not wait for each other.
"""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import triton
import triton.language as tl

from mmpi_ns.ops import ends
from mmpi_ns.ops.gpu_scene import (
    BIAS,
    DEPTH,
    END,
    FLOATS,
    HEIGHT,
    INTERVAL,
    INTS,
    S_SCALE,
    SHARE,
    STEP,
    U0,
    U_SCALE,
    V0,
    V_SCALE,
    WIDTH,
    bilinear,
    is_held,
    nearest,
    one_minus_exp,
    row_of,
    softplus,
    trilinear,
    twice_atanh,
)
from mmpi_ns.ops.march.gpu_hits import local_ray

NEGLIGIBLE = tl.constexpr(ends.NEGLIGIBLE)
NEAREST_ZERO = tl.constexpr(ends.NEAREST_ZERO)
ULPS = tl.constexpr(16 * 2.0**-23)
"""Slack of the border test, as in ``geometry.local_to_ndc``."""


@triton.jit
def _on_plane(row, u, bend_u, v, bend_v, number):
    """Disparity, u and v of planes of MPIs where rays cross them."""
    w = number.to(tl.float32) * tl.load(row + STEP) + tl.load(row + END)
    u, v = u + w * bend_u - tl.load(row + U0), v + w * bend_v - tl.load(row + V0)
    return w, u * tl.load(row + U_SCALE) - 1, v * tl.load(row + V_SCALE) - 1


@triton.jit
def pass_empty(first, count, u, bend_u, v, bend_v, constants, grids, K: tl.constexpr, HEADS: tl.constexpr):
    """How many of each head's samples hold nothing before the first that does: planes of MPIs in empty tiles."""
    head, done = tl.arange(0, HEADS)[None, :], count * 0
    passes, mpi = (head < K) & (count > 0), tl.where(head < K, head, 0) + done
    while tl.max(tl.max(passes.to(tl.int32), 1), 0) > 0:
        number = first - done
        _, x, y = _on_plane(constants + mpi * FLOATS, u, bend_u, v, bend_v, number)
        plane = tl.load(grids + mpi * INTS + DEPTH, passes, 0).to(tl.int32) - 1 - number
        passes = passes & ~is_held(grids, mpi, plane, x, y, passes)
        done += passes.to(tl.int32)
        passes = passes & (done < count)
    return done


@triton.jit
def _put(values, of_heads, is_best, here):
    """Puts the best head's value into a column."""
    return tl.where(here, tl.sum(tl.where(is_best, of_heads, 0), 1)[:, None], values)


@triton.jit
def _choose(first, count, done, u, bend_u, v, bend_v, oz, dz, constants, cube, K: tl.constexpr, HEADS: tl.constexpr,
            HAS_CUBE: tl.constexpr, RAYS: tl.constexpr, STEPS: tl.constexpr):  # fmt: skip
    """The next samples of each ray in the order of distance: head, number, 1/t (-1: none), tangents on the head's
    planes. Equal ones by head."""
    column, head, every = tl.arange(0, STEPS)[None, :], tl.arange(0, HEADS)[None, :], tl.arange(0, HEADS)
    is_mpi = (every < K)[None, :]
    step = tl.load(constants + every * FLOATS + STEP, every < K, 0.0)[None, :]
    end = tl.load(constants + every * FLOATS + END, every < K, 0.0)[None, :]
    heads, numbers = tl.zeros([RAYS, STEPS], tl.int32), tl.zeros([RAYS, STEPS], tl.int32)
    inverse_ts = tl.full([RAYS, STEPS], -1.0, tl.float32)
    us, bends_u, vs, bends_v = inverse_ts * 0, inverse_ts * 0, inverse_ts * 0, inverse_ts * 0
    for i in tl.static_range(STEPS):
        next_ones = tl.where(is_mpi, first - done, first + done)  # m of a plane, or number of the cube's sample
        w = next_ones.to(tl.float32) * step + end
        distances = w * dz / (1 - w * oz)
        if HAS_CUBE:
            in_cube = 1 / ((tl.maximum(next_ones.to(tl.float32), 0.0) + 0.5) * tl.load(cube + 6))
            distances = tl.where(is_mpi, distances, in_cube)
        top, best = tl.max(tl.where(done < count, distances, -1.0), 1, return_indices=True)
        is_best = (head == best[:, None]) & (done < count)
        here = column == i
        heads = tl.where(here, best[:, None].to(tl.int32), heads)
        inverse_ts = tl.where(here, top[:, None], inverse_ts)
        numbers = _put(numbers, next_ones, is_best, here)
        # Computed anew from the head's axes, these would take more registers.
        us, bends_u = _put(us, u, is_best, here), _put(bends_u, bend_u, is_best, here)
        vs, bends_v = _put(vs, v, is_best, here), _put(bends_v, bend_v, is_best, here)
        done += is_best.to(tl.int32)
    return heads, numbers, inverse_ts, us, bends_u, vs, bends_v, done


@triton.jit
def _in_cube(cube, x, y, z):
    """Points normalised to [-1, 1]^3 over the cube."""
    x = 2 * (x - tl.load(cube)) / tl.load(cube + 3) - 1
    y = 2 * (y - tl.load(cube + 1)) / tl.load(cube + 4) - 1
    return x, y, 2 * (z - tl.load(cube + 2)) / tl.load(cube + 5) - 1


@triton.jit
def _count_vote(own_vote, highest, others, grids, reliability, touched, k, head, u, v, s, inside, thick):
    """Adds head k's vote on samples: (mpi vote, highest of the others, sum of e^(other - highest))."""
    is_own = head == k
    looked_up = thick & (inside | is_own)
    vote = trilinear(reliability, grids, k, u, v, s, looked_up)
    counts = looked_up & (head != k)
    grid = grids + k * INTS
    x, y = nearest(u, tl.load(grid + WIDTH)), nearest(v, tl.load(grid + HEIGHT))
    row = row_of(grids, k, nearest(s, tl.load(grid + DEPTH)), y, x, counts)
    counts = counts & (tl.load(touched + row, counts, 0) > 0)
    higher = tl.where(counts, tl.maximum(highest, vote), highest)
    # -1e30 instead of -infinity: differences of it are numbers.
    others = tl.where(counts, others * tl.exp(highest - higher) + tl.exp(vote - higher), others)
    return tl.where(is_own, vote, own_vote), higher, others


@triton.jit
def _blend(x, y, z, dx, dy, dz, constants, grids, cube, reliability, touched, head, inverse_t, tau, asked,
           K: tl.constexpr, HAS_CUBE: tl.constexpr):  # fmt: skip
    """Optical depths after blending (``blending.blend_shares`` and ``blended_optical_depth``)."""
    thick = asked & (tau > NEGLIGIBLE)
    own_vote, highest, others = tau * 0, tau * 0 - 1e30, tau * 0
    for k in range(K):
        mpi = constants + k * FLOATS
        ox, oy, oz, lx, ly, lz = local_ray(mpi, x, y, z, dx, dy, dz)
        ahead = oz * inverse_t + lz > 0
        depth = tl.where(ahead, oz * inverse_t + lz, 1.0)
        u, v = (ox * inverse_t + lx) / depth - tl.load(mpi + U0), (oy * inverse_t + ly) / depth - tl.load(mpi + V0)
        u, v = u * tl.load(mpi + U_SCALE) - 1, v * tl.load(mpi + V_SCALE) - 1
        s = 1 - tl.load(mpi + S_SCALE) * (inverse_t / depth - tl.load(mpi + END))
        inside = (tl.abs(u) <= 1 + ULPS) & (tl.abs(v) <= 1 + ULPS) & (tl.abs(s) <= 1 + ULPS / tl.load(mpi + SHARE))
        u, v, s = tl.where(ahead, u, 0.0), tl.where(ahead, v, 0.0), tl.where(ahead, s, 0.0)
        own_vote, highest, others = _count_vote(
            own_vote, highest, others, grids, reliability, touched, k, head, u, v, s, ahead & inside, thick
        )
    if HAS_CUBE:
        t = 1 / tl.maximum(inverse_t, NEAREST_ZERO)
        u, v, s = _in_cube(cube, x + dx * t, y + dy * t, z + dz * t)
        inside = (inverse_t > 0) & (tl.abs(u) <= 1) & (tl.abs(v) <= 1) & (tl.abs(s) <= 1)
        own_vote, highest, others = _count_vote(
            own_vote, highest, others, grids, reliability, touched, K, head, u, v, s, inside, thick
        )
    sole = others == 0
    odds = tl.where(sole, 0.0, highest - own_vote + tl.log(tl.where(sole, 1.0, others)))
    log_share, log_rest = -softplus(odds), -softplus(-odds)
    alpha, lower = one_minus_exp(tau) * tl.exp(log_share), log_share - tau
    opaque = tl.maximum(log_rest, lower) + softplus(-tl.abs(log_rest - lower))
    thin = tl.minimum(alpha, 0.5)
    thin = twice_atanh(thin / (2 - thin))  # -log(1 - alpha)
    blended = tl.where(alpha < 0.5, thin, tl.maximum(-opaque, 0.0))
    blended = tl.where(sole, tau, blended)
    return tl.where(thick, blended, tau / (K + HAS_CUBE))


@triton.jit
def next_samples(
    goes_on, first, count, done, u, bend_u, v, bend_v, local_z, local_dz, x, y, z, dx, dy, dz,
    constants, grids, biases, cube, density, reliability, touched,
    K: tl.constexpr, HEADS: tl.constexpr, HAS_CUBE: tl.constexpr, BLENDS: tl.constexpr, RAYS: tl.constexpr,
    STEPS: tl.constexpr,
):  # fmt: skip
    """The next samples of rays that go on: whether there is one, its head, plane, NDC, 1/t and optical depth."""
    head, number, inverse_t, u, bend_u, v, bend_v, done = _choose(
        first, count, done, u, bend_u, v, bend_v, local_z, local_dz, constants, cube, K, HEADS, HAS_CUBE, RAYS, STEPS
    )
    met = (inverse_t >= 0) & goes_on[:, None]
    is_mpi = head < K
    mpi, in_mpi = tl.where(is_mpi, head, 0), met & is_mpi
    row = constants + mpi * FLOATS
    w, u, v = _on_plane(row, u, bend_u, v, bend_v, number)
    s = 1 - tl.load(row + S_SCALE) * (w - tl.load(row + END))
    plane = tl.load(grids + mpi * INTS + DEPTH).to(tl.int32) - 1 - number
    raw = bilinear(density, grids, mpi, plane, u, v, in_mpi)
    raw += tl.load(biases + tl.load(grids + mpi * INTS + BIAS) + plane, in_mpi, 0.0)
    tau = softplus(raw) * tl.load(row + INTERVAL)
    if HAS_CUBE:
        in_cube = met & (head == K)
        t = (tl.where(in_cube, number, 0).to(tl.float32) + 0.5) * tl.load(cube + 6)
        p, q, r = _in_cube(cube, x + dx * t, y + dy * t, z + dz * t)
        thick = softplus(trilinear(density, grids, K, p, q, r, in_cube) + tl.load(cube + 7))
        tau = tl.where(is_mpi, tau, thick * tl.load(cube + 8))
        u, v, s = tl.where(is_mpi, u, p), tl.where(is_mpi, v, q), tl.where(is_mpi, s, r)
        plane = tl.where(is_mpi, plane, number)
    if BLENDS:
        tau = _blend(
            x, y, z, dx, dy, dz, constants, grids, cube, reliability, touched, head, inverse_t, tau, met, K, HAS_CUBE
        )
    return met, head, plane, u, v, s, inverse_t, tl.where(met, tau, 0.0), done


@triton.jit
def before(values, STEPS: tl.constexpr):
    """Sum of the earlier columns. Summed, not subtracted: x - x loses what came before a large x."""
    i = tl.arange(0, STEPS)
    earlier = (i[:, None] > i[None, :])[None, :, :]
    return tl.sum(tl.where(earlier, values[:, None, :], 0), 2)
