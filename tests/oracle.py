"""A slow, obvious float64 renderer to compare with. Shares no code with ``mmpi_ns``: plans come in as plain data.

Every plane is tested by intersecting it in ordinary 3D coordinates, every lookup is a loop, every ray is composited
one sample after the other. Blending runs in 60-digit decimals, so that no cancellation needs a clever form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from decimal import Context, Decimal

import numpy as np

FACING = 1e-6
"""Below this cosine between ray and facing direction a ray runs along the planes."""
_DIGITS = Context(prec=60, Emax=10**9, Emin=-(10**9))


# Geometry ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Crossing:
    """Where a ray meets one plane of an MPI."""

    plane: int
    """0 is the nearest plane, L - 1 the last one."""
    live: bool
    inverse_t: float
    u: float
    v: float
    margin: float
    """How far the nearest border is, relative to the numbers that were compared. 1e-12: too close to call."""


def to_local(mpi, point, is_direction=False):
    """A world point (or direction) in the MPI's axes."""
    x = np.asarray(point, np.float64)
    if not is_direction:
        x = x - np.asarray(mpi.origin, np.float64)
    return np.array([np.dot(np.asarray(row, np.float64), x) for row in mpi.axes])


def plane_depth(mpi, plane):
    """Depth of a plane along the facing direction; planes are evenly spaced in 1 / depth."""
    behind = mpi.planes - 1 - plane
    if math.isinf(mpi.far):
        return math.inf if behind == 0 else mpi.near * (mpi.planes - 1) / behind
    return (mpi.planes - 1) / (behind / mpi.near + plane / mpi.far)


def cross_plane(mpi, plane, origin, direction, near, far):
    """Intersects one ray with one plane, or takes its direction for the plane at infinity."""
    o, d = to_local(mpi, origin), to_local(mpi, direction, is_direction=True)
    if not d[2] > FACING:
        return Crossing(plane, False, 0.0, math.nan, math.nan, abs(d[2] - FACING))
    depth = plane_depth(mpi, plane)
    if math.isinf(depth):
        inverse_t, u, v, rounding = 0.0, d[0] / d[2], d[1] / d[2], 1.0
        checks = [] if math.isinf(far) else [-math.inf]
    else:
        t = (depth - o[2]) / d[2]
        inverse_t = 1 / t if t != 0 else math.inf
        u, v = (o[0] + t * d[0]) / depth, (o[1] + t * d[1]) / depth
        rounding = 1 + (abs(o[0]) + abs(o[1]) + abs(t * d[0]) + abs(t * d[1])) / depth
        size = (abs(depth) + abs(o[2])) / d[2] + near
        checks = [(t - near) / size, t / size if t != 0 else -1.0]
        checks += [] if math.isinf(far) else [(far - t) / size]
    u0, u1, v0, v1 = mpi.extent
    rounding += max(abs(x) for x in mpi.extent)
    checks += [(u - u0) / rounding, (u1 - u) / rounding, (v - v0) / rounding, (v1 - v) / rounding]
    margin = min([abs(c) for c in checks] + [abs(d[2] - FACING)])
    return Crossing(plane, all(c >= 0 for c in checks), inverse_t, u, v, margin)


def crossings(mpi, origin, direction, near=0.0, far=math.inf):
    """Every plane of the MPI, nearest first."""
    return [cross_plane(mpi, plane, origin, direction, near, far) for plane in range(mpi.planes)]


def point_to_ndc(mpi, point):
    """(u, v, s) of a finite world point, each in [-1, 1] over the frustum; None behind the MPI."""
    x, y, z = to_local(mpi, point)
    return _ndc(mpi, x, y, z, 1 / z) if z > 0 else None


def direction_to_ndc(mpi, direction):
    """(u, v, s) of a point at infinity; None when it lies behind the MPI."""
    x, y, z = to_local(mpi, direction, is_direction=True)
    return _ndc(mpi, x, y, z, 0.0) if z > 0 else None


def _ndc(mpi, x, y, z, inverse_depth):
    u0, u1, v0, v1 = mpi.extent
    share = (1 / mpi.near - inverse_depth) / (1 / mpi.near - 1 / mpi.far)
    return np.array([2 * (x / z - u0) / (u1 - u0) - 1, 2 * (y / z - v0) / (v1 - v0) - 1, 2 * share - 1])


def ray_point_to_ndc(mpi, origin, direction, inverse_t):
    """(u, v, s) of the point at 1/t along a ray, 0 meaning infinity; None behind the MPI."""
    if inverse_t == 0:
        return direction_to_ndc(mpi, direction)
    return point_to_ndc(mpi, np.asarray(origin, np.float64) + np.asarray(direction, np.float64) / inverse_t)


def covers(mpi, origin, direction, inverse_t):
    """Whether the point at 1/t along a ray lies inside the MPI's frustum."""
    ndc = ray_point_to_ndc(mpi, origin, direction, inverse_t)
    return ndc is not None and bool(np.all(np.abs(ndc) <= 1))


def ndc_to_world(mpi, ndc):
    """World point of an NDC position, or (direction, True) for one on the plane at infinity."""
    u0, u1, v0, v1 = mpi.extent
    u, v = u0 + (ndc[0] + 1) / 2 * (u1 - u0), v0 + (ndc[1] + 1) / 2 * (v1 - v0)
    x, y, z = (np.asarray(row, np.float64) for row in mpi.axes)
    direction = u * x + v * y + z
    share = (ndc[2] + 1) / 2
    inverse_depth = (1 - share) / mpi.near + share / mpi.far
    if inverse_depth == 0:
        return direction, True
    return np.asarray(mpi.origin, np.float64) + direction / inverse_depth, False


def cube_samples(cube, step, origin, direction, near=0.0, far=math.inf):
    """[(index, margin)] of the sample positions (i + 1/2) step that lie inside the cube, tested one by one."""
    o, d = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    lower, upper = np.asarray(cube.lower, np.float64), np.asarray(cube.upper, np.float64)
    reach = np.linalg.norm(o - (lower + upper) / 2) + np.linalg.norm(upper - lower)
    found, margin = [], math.inf
    for i in range(int(reach / step) + 2):
        t = (i + 0.5) * step
        point = o + t * d
        gaps = np.concatenate([point - lower, upper - point])[np.concatenate([d, d]) != 0]
        margin = min(margin, float(np.min(np.abs(gaps))) / reach, abs(t - near) / reach, abs(far - t) / reach)
        if np.all(point >= lower) and np.all(point <= upper) and near <= t <= far:
            found.append(i)
    return found, margin


# Lookups -------------------------------------------------------------------------------------------------------------


def _cell(coordinate, size):
    position = min(max((coordinate + 1) / 2 * (size - 1), 0.0), size - 1.0)
    lower = min(math.floor(position), size - 2)
    return lower, position - lower


def bilinear(image, u, v):
    """Value of an image [H, W, C] at (u, v) in [-1, 1]; corners are texel centres."""
    (x, fx), (y, fy) = _cell(u, image.shape[1]), _cell(v, image.shape[0])
    value = np.zeros(image.shape[2])
    for dy, wy in ((0, 1 - fy), (1, fy)):
        for dx, wx in ((0, 1 - fx), (1, fx)):
            value = value + wy * wx * image[y + dy, x + dx]
    return value


def trilinear(volume, ndc):
    """Value of a volume [D, H, W, C] at (u, v, s) in [-1, 1]^3."""
    z, fz = _cell(ndc[2], volume.shape[0])
    return (1 - fz) * bilinear(volume[z], ndc[0], ndc[1]) + fz * bilinear(volume[z + 1], ndc[0], ndc[1])


# Blending and compositing --------------------------------------------------------------------------------------------


def _share(reliability, cover, own):
    """P of a head among those that cover the point, and what the others have together: exact to 60 digits."""
    exps = {j: _DIGITS.exp(Decimal(float(r))) for j, (r, c) in enumerate(zip(reliability, cover, strict=True)) if c}
    total = rest = Decimal(0)
    for j, e in exps.items():
        total = _DIGITS.add(total, e)
        rest = _DIGITS.add(rest, e) if j != own else rest
    return _DIGITS.divide(exps[own], total), _DIGITS.divide(rest, total)


def log_shares(reliability, cover, own):
    """log P and log(1 - P); -inf for a sole cover."""
    share, rest = _share(reliability, cover, own)
    return float(_DIGITS.ln(share)), -math.inf if rest == 0 else float(_DIGITS.ln(rest))


def blended_depth(tau, reliability, cover, own):
    """-log(1 - alpha') with alpha' = P alpha."""
    share, rest = _share(reliability, cover, own)
    passes = _DIGITS.add(rest, _DIGITS.multiply(share, _DIGITS.exp(Decimal(-float(tau)))))
    return float(_DIGITS.minus(_DIGITS.ln(passes)))


@dataclass(frozen=True)
class Composited:
    """What one ray gathers, sample by sample."""

    weights: np.ndarray
    transmittance: float
    accumulation: float


def composite(taus):
    """Front to back, one sample after the other. taus are optical depths, nearest first."""
    transmittance, weights = 1.0, []
    for tau in taus:
        alpha = -math.expm1(-tau)
        weights.append(transmittance * alpha)
        transmittance *= math.exp(-tau)
    return Composited(np.array(weights), transmittance, 1 - transmittance)


def median_inverse_distance(weights, inverse_t):
    """1/t of the first sample at which half of all gathered weight is reached; 0 for an empty ray."""
    total, so_far = sum(weights), 0.0
    if total <= 0:
        return 0.0
    for weight, inverse in zip(weights, inverse_t, strict=True):
        so_far += weight
        if so_far >= 0.5 * total:
            return inverse
    raise AssertionError("half of the weight is never reached")


@dataclass(frozen=True)
class RaySample:
    """One sample of one head on a ray, before blending."""

    head: int
    plane: int
    inverse_t: float
    tau: float
    color: np.ndarray
    reliability: np.ndarray = field(default_factory=lambda: np.zeros(1))
    """Of every head at the sample's position. [H]"""
    cover: np.ndarray = field(default_factory=lambda: np.ones(1, bool))
    """Which heads cover the position; the sample's own head does. [H]"""


@dataclass(frozen=True)
class RenderedRay:
    """A whole ray, with its samples in the order in which they were met."""

    samples: list[RaySample]
    taus: np.ndarray
    weights: np.ndarray
    color: np.ndarray
    accumulation: float
    transmittance: float
    median_inverse_distance: float


def render_ray(samples_by_head, blends=True):
    """Merges the samples of all heads by distance, blends each by reliability if asked, and composites front to back.

    Equal distances are met in the order (head, plane).
    """
    samples = sorted((s for head in samples_by_head for s in head), key=lambda s: (-s.inverse_t, s.head, s.plane))
    taus = [blended_depth(s.tau, s.reliability, s.cover, s.head) if blends else s.tau for s in samples]
    gathered = composite(taus)
    color = np.zeros(3)
    for weight, sample in zip(gathered.weights, samples, strict=True):
        color = color + weight * np.asarray(sample.color, np.float64)
    median = median_inverse_distance(list(gathered.weights), [s.inverse_t for s in samples])
    return RenderedRay(
        samples, np.array(taus), gathered.weights, color, gathered.accumulation, gathered.transmittance, median
    )
