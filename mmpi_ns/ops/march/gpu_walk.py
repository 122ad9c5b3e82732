"""Walk of a ray through a scene on a GPU: intersections with planes and cube, order of samples, lookups, blending.

The counterpart of ``cpp/crossings.h``, ``cpp/walk.h`` and ``cpp/blend.h``; the references of intersections, with their
derivation, are ``geometry.plane_hits``, ``geometry.cube_hits`` and ``sampler.crossings``. The order of samples needs no
lookup: every head's planes come near to far, and the nearest of the heads' next ones is taken. So a chunk of samples is
chosen first and then looked up at once, and its loads do not wait for each other.
"""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import triton
import triton.language as tl

from mmpi_ns.ops import ends
from mmpi_ns.ops.gpu_scene import BIAS, DEPTH, HEIGHT, INTS, STORED, WIDTH, cell, one_minus_exp, row_of
from mmpi_ns.scene.geometry import FACING_EPS

# Columns of an MPI's row in ``SceneLayout.constants``.
ORIGIN, AXES, EXTENT, STEP, END, LAST = map(tl.constexpr, (0, 3, 12, 16, 17, 18))
SHARE, S_SCALE, U0, U_SCALE, V0, V_SCALE, INTERVAL, FLOATS = map(tl.constexpr, range(19, 27))
EPS = tl.constexpr(FACING_EPS)
ENDLESS, REACHED = tl.constexpr(1e30), tl.constexpr(1e9)
"""Distance that stands for never, and number of samples in the cube beyond which a ray is taken to miss it."""
NEGLIGIBLE = tl.constexpr(ends.NEGLIGIBLE)
NEAREST_ZERO = tl.constexpr(ends.NEAREST_ZERO)
ULPS = tl.constexpr(16 * 2.0**-23)
BORDER = tl.constexpr(1 + 16 * 2.0**-23)
"""Slack of the border test, as in ``geometry.local_to_ndc``. Triton 3.8's interpreter divides no constant by
an array."""

# Lookups and arithmetic ----------------------------------------------------------------------------------------------


@triton.jit
def bilinear(table, grids, head, plane, u, v, mask):
    """A one-channel table at NDC (u, v) on a plane; 0 where masked."""
    x, fx = cell(u, tl.load(grids + head * INTS + WIDTH))
    y, fy = cell(v, tl.load(grids + head * INTS + HEIGHT))
    a = tl.load(table + row_of(grids, head, plane, y, x, mask), mask, 0.0)
    b = tl.load(table + row_of(grids, head, plane, y, x + 1, mask), mask, 0.0)
    c = tl.load(table + row_of(grids, head, plane, y + 1, x, mask), mask, 0.0)
    d = tl.load(table + row_of(grids, head, plane, y + 1, x + 1, mask), mask, 0.0)
    return (1 - fx) * (1 - fy) * a + fx * (1 - fy) * b + (1 - fx) * fy * c + fx * fy * d


@triton.jit
def trilinear(table, grids, head, u, v, s, mask):
    """A one-channel table at NDC (u, v, s), s running over planes or layers; 0 where masked."""
    z, fz = cell(s, tl.load(grids + head * INTS + DEPTH))
    near = bilinear(table, grids, head, z, u, v, mask)
    return near * (1 - fz) + bilinear(table, grids, head, z + 1, u, v, mask) * fz


@triton.jit
def nearest(coordinate, size):
    """Texel nearest to a coordinate in [-1, 1]; halves go to the even one, as torch.round has it."""
    last = (size - 1).to(tl.float32)
    position = tl.minimum(tl.maximum((coordinate + 1) * (0.5 * last), 0.0), last)
    down = tl.floor(position)
    odd = down - 2 * tl.floor(0.5 * down)
    up = ((position - down > 0.5) | ((position - down == 0.5) & (odd == 1))).to(tl.float32)
    return (down + up).to(tl.int64)


@triton.jit
def twice_atanh(z):
    """log((1 + z) / (1 - z)) for |z| <= 1/3, to a few ulp."""
    q = z * z
    p = 1.0 / 15
    p = p * q + 1.0 / 13
    p = p * q + 1.0 / 11
    p = p * q + 1.0 / 9
    p = p * q + 1.0 / 7
    p = p * q + 1.0 / 5
    p = p * q + 1.0 / 3
    return 2 * z * (p * q + 1.0)


@triton.jit
def softplus(x):
    """log(1 + e^x)."""
    y = tl.exp(-tl.abs(x))
    return tl.maximum(x, 0.0) + twice_atanh(y / (2 + y))


# Crossings -----------------------------------------------------------------------------------------------------------


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
    """Range of m, narrowed to p (m step + end) <= q."""
    slope, rest = p * step, q - p * end
    bound = rest / tl.where(slope == 0, 1.0, slope)
    high = tl.where(slope > 0, tl.minimum(high, bound), high)
    low = tl.where(slope < 0, tl.maximum(low, bound), low)
    return low, high, never | ((slope == 0) & (rest < 0)) | (bound != bound)


@triton.jit
def _is_intersected(m, near, far, q_far, bend_u, left, right, bend_v, up, down, oz, step, end, last):
    """Whether a ray intersects plane m, by all conditions, because the division may be off by one."""
    w = m * step + end
    intersected = (w * oz < 1) & (m >= 0) & (m <= last) & (near * w <= 1) & (far * w <= q_far)
    intersected = intersected & (bend_u * w <= right) & (-bend_u * w <= left)
    return intersected & (bend_v * w <= down) & (-bend_v * w <= up)


@triton.jit
def _settle(m, out, near, far, q_far, bend_u, left, right, bend_v, up, down, oz, step, end, last):
    """The last plane of a range: m, or the next one out, or the next one in."""
    more = _is_intersected(m + out, near, far, q_far, bend_u, left, right, bend_v, up, down, oz, step, end, last)
    less = _is_intersected(m, near, far, q_far, bend_u, left, right, bend_v, up, down, oz, step, end, last)
    return tl.where(more, m + out, tl.where(less, m, m - out))


@triton.jit
def _intersected_range(frame, u, bend_u, v, bend_v, oz, dz, near, far):
    """Number m of the nearest intersected plane of each ray in each MPI, and the number of intersected planes."""
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
    """Number of each ray's first sample in the cube, and the number of its samples there."""
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
    """Samples of rays in the allowed heads (``sampler.crossings``): for each head the number of its first sample and of
    all, the tangents on its planes, and the ray's origin and direction along its axis; and whether the ray is fully
    covered."""
    head, at = tl.arange(0, HEADS)[None, :], ray[:, None]
    is_mpi, near, far = head < K, tl.load(nears + at), tl.load(fars + at)
    frame = scene + tl.where(is_mpi, head, 0) * FLOATS
    ox, oy, oz, lx, ly, lz = local_ray(frame, x, y, z, dx, dy, dz)
    # A ray's tangents on the plane of disparity w are u + w bend_u and v + w bend_v.
    depth = tl.where(lz > EPS, lz, 1.0)
    u, v = lx / depth, ly / depth
    bend_u, bend_v = ox - oz * u, oy - oz * v
    first, count = _intersected_range(frame, u, bend_u, v, bend_v, oz, lz, near, far)
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
    fully_covered = tl.max(count, 1) > 0
    if ALLOWS + CHOOSES > 0:
        # An MPI reaches to infinity, and the first one is entered before the first content. One plane before the
        # first intersected one bounds the entry; behind the camera: the ray starts inside.
        intersected, step, end = is_mpi & (count > 0), tl.load(frame + STEP), tl.load(frame + END)
        w = tl.minimum((first + 1).to(tl.float32), tl.load(frame + LAST)) * step + end
        starts_inside = w * oz >= 1
        entry = w * lz / tl.where(starts_inside, 1.0, 1 - w * oz)
        entered = intersected & (starts_inside | (entry * content_near >= 1))
        endless = intersected & (first - count < 0) & (end == 0)
        fully_covered = fully_covered & (tl.max(entered.to(tl.int32), 1) > 0) & (tl.max(endless.to(tl.int32), 1) > 0)
    return first, count, u, bend_u, v, bend_v, oz, lz, fully_covered


# Samples -------------------------------------------------------------------------------------------------------------


@triton.jit
def _on_plane(row, u, bend_u, v, bend_v, number):
    """Disparity, u and v of planes of MPIs where rays intersect them."""
    w = number.to(tl.float32) * tl.load(row + STEP) + tl.load(row + END)
    u, v = u + w * bend_u - tl.load(row + U0), v + w * bend_v - tl.load(row + V0)
    return w, u * tl.load(row + U_SCALE) - 1, v * tl.load(row + V_SCALE) - 1


@triton.jit
def pass_empty(first, count, u, bend_u, v, bend_v, constants, grids, K: tl.constexpr, HEADS: tl.constexpr):
    """Number of each head's samples before the first occupied one: planes of MPIs in empty tiles."""
    head, done = tl.arange(0, HEADS)[None, :], count * 0
    passes, mpi = (head < K) & (count > 0), tl.where(head < K, head, 0) + done
    while tl.max(tl.max(passes.to(tl.int32), 1), 0) > 0:
        number = first - done
        _, x, y = _on_plane(constants + mpi * FLOATS, u, bend_u, v, bend_v, number)
        plane = tl.load(grids + mpi * INTS + DEPTH, passes, 0).to(tl.int32) - 1 - number
        # Whether any of the four surrounding texels is stored.
        column, _ = cell(x, tl.load(grids + mpi * INTS + WIDTH))
        row, _ = cell(y, tl.load(grids + mpi * INTS + HEIGHT))
        held = row_of(grids, mpi, plane, row, column, passes) >= STORED
        held = held | (row_of(grids, mpi, plane, row, column + 1, passes) >= STORED)
        held = held | (row_of(grids, mpi, plane, row + 1, column, passes) >= STORED)
        passes = passes & ~(held | (row_of(grids, mpi, plane, row + 1, column + 1, passes) >= STORED))
        done += passes.to(tl.int32)
        passes = passes & (done < count)
    return done


@triton.jit
def _put(values, of_heads, is_best, here):
    """A column filled with the best head's value."""
    return tl.where(here, tl.sum(tl.where(is_best, of_heads, 0), 1)[:, None], values)


@triton.jit
def _choose(first, count, done, u, bend_u, v, bend_v, oz, dz, constants, cube, K: tl.constexpr, HEADS: tl.constexpr,
            HAS_CUBE: tl.constexpr, RAYS: tl.constexpr, STEPS: tl.constexpr):  # fmt: skip
    """Next samples of each ray in order of distance, equal ones by head: head, number, 1/t (-1: none), tangents on the
    head's planes."""
    column, head, every = tl.arange(0, STEPS)[None, :], tl.arange(0, HEADS)[None, :], tl.arange(0, HEADS)
    is_mpi = (every < K)[None, :]
    step = tl.load(constants + every * FLOATS + STEP, every < K, 0.0)[None, :]
    end = tl.load(constants + every * FLOATS + END, every < K, 0.0)[None, :]
    heads, numbers = tl.zeros([RAYS, STEPS], tl.int32), tl.zeros([RAYS, STEPS], tl.int32)
    inverse_ts = tl.full([RAYS, STEPS], -1.0, tl.float32)
    us, bends_u, vs, bends_v = inverse_ts * 0, inverse_ts * 0, inverse_ts * 0, inverse_ts * 0
    for i in range(STEPS):
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
        # Recomputed from the head's axes, these would take more registers.
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
def in_mpi(constants, k, x, y, z, dx, dy, dz, inverse_t):
    """NDC of a sample of a ray in MPI k, and whether it lies in its frustum (``geometry.local_to_ndc``)."""
    mpi = constants + k * FLOATS
    ox, oy, oz, lx, ly, lz = local_ray(mpi, x, y, z, dx, dy, dz)
    ahead = oz * inverse_t + lz > 0
    depth = tl.where(ahead, oz * inverse_t + lz, 1.0)
    u, v = (ox * inverse_t + lx) / depth - tl.load(mpi + U0), (oy * inverse_t + ly) / depth - tl.load(mpi + V0)
    u, v = u * tl.load(mpi + U_SCALE) - 1, v * tl.load(mpi + V_SCALE) - 1
    s = 1 - tl.load(mpi + S_SCALE) * (inverse_t / depth - tl.load(mpi + END))
    inside = (tl.abs(u) <= BORDER) & (tl.abs(v) <= BORDER) & (tl.abs(s) <= 1 / tl.load(mpi + SHARE) * ULPS + 1)
    return tl.where(ahead, u, 0.0), tl.where(ahead, v, 0.0), tl.where(ahead, s, 0.0), ahead & inside


@triton.jit
def in_cube(cube, x, y, z, dx, dy, dz, inverse_t):
    """Position of a sample in the cube, and whether it lies inside."""
    t = 1 / tl.maximum(inverse_t, NEAREST_ZERO)
    u, v, s = _in_cube(cube, x + dx * t, y + dy * t, z + dz * t)
    inside = (inverse_t > 0) & (tl.abs(u) <= 1) & (tl.abs(v) <= 1) & (tl.abs(s) <= 1)
    return u, v, s, inside


@triton.jit
def was_trained(touched, grids, head, u, v, s, mask):
    """Whether the texel nearest to NDC (u, v, s) was trained; not where masked."""
    grid = grids + head * INTS
    x, y = nearest(u, tl.load(grid + WIDTH)), nearest(v, tl.load(grid + HEIGHT))
    row = row_of(grids, head, nearest(s, tl.load(grid + DEPTH)), y, x, mask)
    return mask & (tl.load(touched + row, mask, 0) > 0)


@triton.jit
def _count_vote(vote_of_head, highest, others, grids, reliability, touched, k, head, u, v, s, inside, thick):
    """Votes on samples with that of head k: (of their own head, highest of the others, sum of e^(other - highest))."""
    is_own = head == k
    looked_up = thick & (inside | is_own)
    vote = trilinear(reliability, grids, k, u, v, s, looked_up)
    counts = was_trained(touched, grids, k, u, v, s, looked_up & (head != k))
    higher = tl.where(counts, tl.maximum(highest, vote), highest)
    # -1e30 instead of -infinity: differences of it are numbers.
    others = tl.where(counts, others * tl.exp(highest - higher) + tl.exp(vote - higher), others)
    return tl.where(is_own, vote, vote_of_head), higher, others


@triton.jit
def blend(tau, log_share, log_rest, sole):
    """Optical depths after blending (``blending.blended_optical_depth``), and alphas times shares."""
    alpha, lower = one_minus_exp(tau) * tl.exp(log_share), log_share - tau
    opaque = tl.maximum(log_rest, lower) + softplus(-tl.abs(log_rest - lower))
    thin = tl.minimum(alpha, 0.5)  # of which -log(1 - alpha) is
    blended = tl.where(alpha < 0.5, twice_atanh(thin / (2 - thin)), tl.maximum(-opaque, 0.0))
    return tl.where(sole, tau, blended), alpha


@triton.jit
def _blend(x, y, z, dx, dy, dz, constants, grids, cube, reliability, touched, head, inverse_t, tau, asked,
           K: tl.constexpr, HAS_CUBE: tl.constexpr):  # fmt: skip
    """Optical depths after blending (``blending.blend_shares`` and ``blend``)."""
    thick = asked & (tau > NEGLIGIBLE)
    vote_of_head, highest, others = tau * 0, tau * 0 - 1e30, tau * 0
    for k in range(K):
        u, v, s, inside = in_mpi(constants, k, x, y, z, dx, dy, dz, inverse_t)
        vote_of_head, highest, others = _count_vote(
            vote_of_head, highest, others, grids, reliability, touched, k, head, u, v, s, inside, thick
        )
    if HAS_CUBE:
        u, v, s, inside = in_cube(cube, x, y, z, dx, dy, dz, inverse_t)
        vote_of_head, highest, others = _count_vote(
            vote_of_head, highest, others, grids, reliability, touched, K, head, u, v, s, inside, thick
        )
    sole = others == 0
    odds = tl.where(sole, 0.0, highest - vote_of_head + tl.log(tl.where(sole, 1.0, others)))
    blended, _ = blend(tau, -softplus(odds), -softplus(-odds), sole)
    return tl.where(thick, blended, tau / (K + HAS_CUBE))


@triton.jit
def next_samples(
    goes_on, first, count, done, u, bend_u, v, bend_v, local_z, local_dz, x, y, z, dx, dy, dz,
    constants, grids, biases, cube, density, reliability, touched,
    K: tl.constexpr, HEADS: tl.constexpr, HAS_CUBE: tl.constexpr, BLENDS: tl.constexpr, RAYS: tl.constexpr,
    STEPS: tl.constexpr,
):  # fmt: skip
    """Next samples of active rays: whether there is one, its head, plane, NDC, 1/t and optical depth."""
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
    """Sum of the earlier columns. Summed, not subtracted: x - x loses small terms before a large x."""
    i = tl.arange(0, STEPS)
    earlier = (i[:, None] > i[None, :])[None, :, :]
    return tl.sum(tl.where(earlier, values[:, None, :], 0), 2)
