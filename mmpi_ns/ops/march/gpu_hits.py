"""Where rays cross planes, in one launch; the reference is ``geometry.plane_hits``, some eighty operations."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl

from mmpi_ns.ops.gpu_scene import block_size, launch
from mmpi_ns.ops.layout import SceneLayout, shaped
from mmpi_ns.ops.march.rays import Rays
from mmpi_ns.scene.geometry import FACING_EPS, PlaneHits

EPS = tl.constexpr(FACING_EPS)
# Columns of ``SceneLayout.frame_rows``.
ORIGIN = tl.constexpr(0)
AXES = tl.constexpr(3)
EXTENT = tl.constexpr(12)
STEP = tl.constexpr(16)
END = tl.constexpr(17)
LAST = tl.constexpr(18)
FLOATS = tl.constexpr(19)
PAIRS = 128
"""Rays times MPIs of a program."""


@triton.jit
def _rotate(axes, x, y, z):
    """The frame's axes times a vector, in the order of ``geometry.rotate``."""
    a = tl.load(axes) * x + tl.load(axes + 1) * y + tl.load(axes + 2) * z
    b = tl.load(axes + 3) * x + tl.load(axes + 4) * y + tl.load(axes + 5) * z
    return a, b, tl.load(axes + 6) * x + tl.load(axes + 7) * y + tl.load(axes + 8) * z


@triton.jit
def _narrow(low, high, never, p, q, step, end):
    """The range of m within p (m step + end) <= q too."""
    slope, rest = p * step, q - p * end
    bound = rest / tl.where(slope == 0, 1.0, slope)
    high = tl.where(slope > 0, tl.minimum(high, bound), high)
    low = tl.where(slope < 0, tl.maximum(low, bound), low)
    return low, high, never | ((slope == 0) & (rest < 0))


@triton.jit
def _is_live(m, near, far, q_far, bend_u, left, right, bend_v, up, down, oz, step, end, last):
    """Whether plane m meets all conditions: they decide where the division may be off by one."""
    w = m * step + end
    live = (w * oz < 1) & (m >= 0) & (m <= last) & (near * w <= 1) & (far * w <= q_far)
    live = live & (bend_u * w <= right) & (-bend_u * w <= left)
    return live & (bend_v * w <= down) & (-bend_v * w <= up)


@triton.jit
def _settle(m, out, near, far, q_far, bend_u, left, right, bend_v, up, down, oz, step, end, last):
    """The last plane of a range: m, or the next one out, or the next one in."""
    more = _is_live(m + out, near, far, q_far, bend_u, left, right, bend_v, up, down, oz, step, end, last)
    less = _is_live(m, near, far, q_far, bend_u, left, right, bend_v, up, down, oz, step, end, last)
    return tl.where(more, m + out, tl.where(less, m, m - out))


@triton.jit(do_not_specialize=("size",))
def hits_kernel(
    origins, directions, nears, fars, frames, firsts, counts, us, vs, local_origins, local_directions, size,
    K: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The live range of each ray in each MPI, and the affine maps from disparity to (u, v)."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = i < size
    at = tl.where(exists, i, 0)
    ray, frame = at // K, frames + at % K * FLOATS
    x, y, z = tl.load(origins + 3 * ray), tl.load(origins + 3 * ray + 1), tl.load(origins + 3 * ray + 2)
    x, y, z = x - tl.load(frame), y - tl.load(frame + 1), z - tl.load(frame + 2)
    ox, oy, oz = _rotate(frame + AXES, x, y, z)
    x, y, z = tl.load(directions + 3 * ray), tl.load(directions + 3 * ray + 1), tl.load(directions + 3 * ray + 2)
    dx, dy, dz = _rotate(frame + AXES, x, y, z)
    facing = dz > EPS
    depth = tl.where(facing, dz, 1.0)
    u, v = dx / depth, dy / depth
    bend_u, bend_v = ox - oz * u, oy - oz * v
    # Half-spaces p w <= q of the disparity w: from near to far, and within the extent.
    far, extent = 1 / tl.load(fars + ray), frame + EXTENT
    p_near, p_far = dz * tl.load(nears + ray) + oz, -(dz + oz * far)
    left, right = u - tl.load(extent), tl.load(extent + 1) - u
    up, down = v - tl.load(extent + 2), tl.load(extent + 3) - v
    step, end, last = tl.load(frame + STEP), tl.load(frame + END), tl.load(frame + LAST)
    low, high, never = tl.zeros([BLOCK], tl.float32), last + 0 * oz, oz != oz
    low, high, never = _narrow(low, high, never, p_near, far * 0 + 1, step, end)
    low, high, never = _narrow(low, high, never, p_far, -far, step, end)
    low, high, never = _narrow(low, high, never, bend_u, right, step, end)
    low, high, never = _narrow(low, high, never, -bend_u, left, step, end)
    low, high, never = _narrow(low, high, never, bend_v, down, step, end)
    low, high, never = _narrow(low, high, never, -bend_v, up, step, end)
    high = tl.where(never, -1.0, tl.maximum(tl.floor(high), -1.0))
    low = tl.where(never, last + 1, tl.minimum(tl.ceil(low), last + 1))
    high = _settle(high, 1, p_near, p_far, -far, bend_u, left, right, bend_v, up, down, oz, step, end, last)
    low = _settle(low, -1, p_near, p_far, -far, bend_u, left, right, bend_v, up, down, oz, step, end, last)
    tl.store(firsts + i, high.to(tl.int64), exists)
    tl.store(counts + i, tl.where(facing, tl.maximum(high - low + 1, 0.0), 0.0).to(tl.int64), exists)
    tl.store(us + 2 * i, u, exists)
    tl.store(us + 2 * i + 1, bend_u, exists)
    tl.store(vs + 2 * i, v, exists)
    tl.store(vs + 2 * i + 1, bend_v, exists)
    _store(local_origins + 3 * i, ox, oy, oz, exists)
    _store(local_directions + 3 * i, dx, dy, dz, exists)


@triton.jit
def _store(to, x, y, z, exists):
    tl.store(to, x, exists)
    tl.store(to + 1, y, exists)
    tl.store(to + 2, z, exists)


def plane_hits(layout: SceneLayout, rays: Rays) -> PlaneHits:
    """See ``geometry.plane_hits``; in float32."""
    num_rays, count, device = len(rays.origins), len(layout.mpis), rays.origins.device
    shape, size, block = (num_rays, count), num_rays * count, block_size(PAIRS, device)
    ranges = [torch.empty(shape, dtype=torch.int64, device=device) for _ in range(2)]
    parts = [torch.empty(*shape, width, device=device) for width in (2, 2, 3, 3)]
    bounded = [shaped(x, num_rays, n) for x, n in zip(rays[:4], (3, 3, 1, 1), strict=True)]
    frames = shaped(layout.frame_rows, count, FLOATS.value)
    launch(hits_kernel, size, block, *bounded, frames, *ranges, *parts, size, K=count, BLOCK=block)
    return PlaneHits(*ranges, *parts)
