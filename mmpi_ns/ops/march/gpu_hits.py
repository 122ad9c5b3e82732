"""Where rays cross planes and the cube, on a GPU: the counterpart of ``cpp/crossings.h``, computed where rays march.

The references, which say why, are ``geometry.plane_hits``, ``geometry.cube_hits`` and ``march.crossings``.
"""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import triton
import triton.language as tl

from mmpi_ns.ops.gpu_scene import AXES, END, EXTENT, FLOATS, LAST, ORIGIN, STEP
from mmpi_ns.scene.geometry import FACING_EPS

EPS = tl.constexpr(FACING_EPS)
ENDLESS = tl.constexpr(1e30)
"""Distance to what a ray never reaches,"""
REACHED = tl.constexpr(1e9)
"""and number of samples of the cube beyond which it reaches none."""


@triton.jit
def _rotate(frame, x, y, z):
    """The frame's axes times a vector, in the order of ``geometry.rotate``."""
    axes = frame + AXES
    a = tl.load(axes) * x + tl.load(axes + 1) * y + tl.load(axes + 2) * z
    b = tl.load(axes + 3) * x + tl.load(axes + 4) * y + tl.load(axes + 5) * z
    return a, b, tl.load(axes + 6) * x + tl.load(axes + 7) * y + tl.load(axes + 8) * z


@triton.jit
def local_ray(frame, x, y, z, dx, dy, dz):
    """Origin and direction of a ray in an MPI's axes, relative to the MPI's origin."""
    # Differences first, to keep precision far from the world origin.
    x, y, z = x - tl.load(frame + ORIGIN), y - tl.load(frame + ORIGIN + 1), z - tl.load(frame + ORIGIN + 2)
    ox, oy, oz = _rotate(frame, x, y, z)
    dx, dy, dz = _rotate(frame, dx, dy, dz)
    return ox, oy, oz, dx, dy, dz


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


@triton.jit
def _live_range(frame, u, bend_u, v, bend_v, oz, dz, near, far):
    """Of each ray in each MPI the number m of the nearest live plane, and how many are live."""
    # Half-spaces p w <= q of the disparity w: from near to far, and within the extent.
    far, extent = 1 / far, frame + EXTENT
    p_near, p_far = dz * near + oz, -(dz + oz * far)
    left, right = u - tl.load(extent), tl.load(extent + 1) - u
    up, down = v - tl.load(extent + 2), tl.load(extent + 3) - v
    step, end, last = tl.load(frame + STEP), tl.load(frame + END), tl.load(frame + LAST)
    low, high, never = 0 * oz, last + 0 * oz, oz != oz
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
    return high.to(tl.int32), tl.where(dz > EPS, tl.maximum(high - low + 1, 0.0), 0.0).to(tl.int32)


@triton.jit
def _within(enter, leave, o, d, lower, upper):
    """The part of a range of distances that lies between two opposite faces."""
    flat = d == 0
    a, b = (lower - o) / tl.where(flat, 1.0, d), (upper - o) / tl.where(flat, 1.0, d)
    reach = tl.where((o >= lower) & (o <= upper), ENDLESS, -ENDLESS)
    enter = tl.maximum(enter, tl.where(flat, -reach, tl.minimum(a, b)))
    return enter, tl.minimum(leave, tl.where(flat, reach, tl.maximum(a, b)))


@triton.jit
def _cube_range(cube, x, y, z, dx, dy, dz, near, far):
    """Of each ray the number of its first sample in the cube, and how many it has there."""
    enter, leave = _within(near, far, x, dx, tl.load(cube), tl.load(cube + 9))
    enter, leave = _within(enter, leave, y, dy, tl.load(cube + 1), tl.load(cube + 10))
    enter, leave = _within(enter, leave, z, dz, tl.load(cube + 2), tl.load(cube + 11))
    a, b, c, step = tl.load(cube + 3), tl.load(cube + 4), tl.load(cube + 5), tl.load(cube + 6)
    start, stop = enter / step - 0.5, leave / step - 0.5
    hit = (enter <= leave) & (tl.abs(start) < REACHED) & (stop - start <= 2 * tl.sqrt(a * a + b * b + c * c) / step)
    start, stop = tl.ceil(tl.where(hit, start, 0.0)), tl.floor(tl.where(hit, stop, 0.0))
    return start.to(tl.int32), tl.where(hit, tl.maximum(stop - start + 1, 0.0), 0.0).to(tl.int32)


@triton.jit
def cross(ray, exists, x, y, z, dx, dy, dz, nears, fars, allowed, priorities, scene, cube, content_near,
          K: tl.constexpr, HEADS: tl.constexpr, HAS_CUBE: tl.constexpr, ALLOWS: tl.constexpr,
          CHOOSES: tl.constexpr):  # fmt: skip
    """The samples of rays in the heads that may answer them (``march.crossings``): of each head the number of its first
    one and how many there are, the tangents on its planes, and the ray's origin and direction along its axis; and
    whether the heads must explain the ray."""
    head, at = tl.arange(0, HEADS)[None, :], ray[:, None]
    is_mpi, near, far = head < K, tl.load(nears + at), tl.load(fars + at)
    frame = scene + tl.where(is_mpi, head, 0) * FLOATS
    ox, oy, oz, lx, ly, lz = local_ray(frame, x, y, z, dx, dy, dz)
    # A ray's tangents on the plane of disparity w are u + w bend_u and v + w bend_v.
    depth = tl.where(lz > EPS, lz, 1.0)
    u, v = lx / depth, ly / depth
    bend_u, bend_v = ox - oz * u, oy - oz * v
    first, count = _live_range(frame, u, bend_u, v, bend_v, oz, lz, near, far)
    count = tl.where(exists[:, None] & is_mpi, count, 0)
    if CHOOSES:
        met = tl.load(priorities + at * K + head, count > 0, -1.0)
        count = tl.where(head == tl.argmax(met, 1)[:, None], count, 0)
    if HAS_CUBE:
        start, some = _cube_range(cube, x, y, z, dx, dy, dz, near, far)
        first = tl.where(head == K, start, first)
        count = tl.where(exists[:, None] & (head == K), some, count)
    if ALLOWS:
        may = tl.load(allowed + at * (K + HAS_CUBE) + head, head < K + HAS_CUBE, 0)
        count = tl.where(may != 0, count, 0)
    explained = tl.max(count, 1) > 0
    if ALLOWS + CHOOSES > 0:
        # An MPI reaches to infinity, and the first one is entered before the first content. One plane before the
        # first live one bounds the entry; behind the camera: the ray starts inside.
        live, step, end = is_mpi & (count > 0), tl.load(frame + STEP), tl.load(frame + END)
        w = tl.minimum((first + 1).to(tl.float32), tl.load(frame + LAST)) * step + end
        starts_inside = w * oz >= 1
        entry = w * lz / tl.where(starts_inside, 1.0, 1 - w * oz)
        entered = live & (starts_inside | (entry * content_near >= 1))
        endless = live & (first - count < 0) & (end == 0)
        explained = explained & (tl.max(entered.to(tl.int32), 1) > 0) & (tl.max(endless.to(tl.int32), 1) > 0)
    return first, count, u, bend_u, v, bend_v, oz, lz, explained
