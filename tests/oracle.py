"""Slow, obvious float64 forms to compare with, and their exact gradients. Share no code with ``mmpi_ns``: plans come in
as plain data.

One ray at a time, every plane by itself, every lookup and every sample in a loop. Blending runs in 60-digit decimals,
so that no cancellation needs a clever form.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, field
from decimal import Context, Decimal

import numpy as np

FACING = 1e-6
"""Below this cosine between ray and facing direction a ray runs along the planes."""
_DIGITS = Context(prec=60, Emax=10**9, Emin=-(10**9))


# Geometry ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Crossings:
    """Where one ray meets the L planes of an MPI, nearest plane first; all [L].

    ``size_uv`` and ``size_q`` are sums of the magnitudes that (u, v) and 1/t are made of: an arithmetic of unit
    roundoff e cannot promise more than a small multiple of e times these.
    """

    intersected: np.ndarray
    inverse_t: np.ndarray
    u: np.ndarray
    v: np.ndarray
    size_uv: np.ndarray
    size_q: np.ndarray
    margin: np.ndarray
    """Distance to the nearest border that decides about ``intersected``, relative to such a sum."""


def in_frame(mpi, origin, direction):
    """Origin and direction in the MPI's axes, and the sum of the offset's magnitudes."""
    offset, axes = np.asarray(origin, np.float64) - np.asarray(mpi.origin, np.float64), np.asarray(mpi.axes, np.float64)
    return axes @ offset, axes @ np.asarray(direction, np.float64), float(np.abs(offset).sum())


def disparities(mpi):
    """1 / depth of every plane, evenly spaced from near to far (or to infinity, 0). [L]"""
    share = np.arange(mpi.planes) / (mpi.planes - 1)
    return (1 - share) / mpi.near + share / mpi.far


def crossings(mpi, origin, direction, near=0.0, far=math.inf):
    """Intersects a ray with every plane of an MPI."""
    o, d, reach = in_frame(mpi, origin, direction)
    facing_margin = abs(d[2] - FACING)
    if not d[2] > FACING:
        nothing = np.zeros(mpi.planes)
        return Crossings(nothing > 0, nothing, nothing, nothing, nothing, nothing, nothing + facing_margin)
    w = disparities(mpi)
    ahead = 1 - w * o[2]
    q = w * d[2] / np.where(ahead != 0, ahead, np.nan)
    u, v = (d[i] / d[2] + w * (o[i] - o[2] * (d[i] / d[2])) for i in (0, 1))
    steep = (1 + max(abs(d[0]), abs(d[1])) / d[2]) / d[2]
    size_uv = steep * (1 + w * reach)
    with np.errstate(invalid="ignore", divide="ignore"):
        size_q = np.abs(q) * (1 + 1 / d[2] + w * reach / np.abs(ahead))
    u0, u1, v0, v1 = mpi.extent
    tests = [(gap, size_uv + abs(limit)) for gap, limit in ((u - u0, u0), (u1 - u, u1), (v - v0, v0), (v1 - v, v1))]
    # t >= near and t <= far, both multiplied out so that nothing is divided by zero.
    tests.append((ahead - near * w * d[2], 1 + w * (near + reach)))
    if far < math.inf:
        tests.append((w * d[2] - ahead / far, w + (1 + w * reach) / far))
    tests.append((np.where(ahead > 0, ahead, np.minimum(ahead, -1e-300)), 1 + w * reach))
    intersected = np.all([gap >= 0 for gap, _ in tests], axis=0)
    margin = np.min([np.abs(gap) / size for gap, size in tests], axis=0)
    return Crossings(intersected, q, u, v, size_uv, size_q, np.minimum(margin, facing_margin))


def place_in(mpi, origin, direction, inverse_t):
    """(u, v, s) of the point at 1/t along a ray (0: infinity), each in [-1, 1] over the frustum, and the size of its
    numbers; None behind the MPI."""
    o, d, reach = in_frame(mpi, origin, direction)
    x, y, z = o * inverse_t + d
    if z <= 0:
        return None
    (u0, u1, v0, v1), depth = mpi.extent, 1 / mpi.near - 1 / mpi.far
    ndc = np.array([(x / z - u0) / (u1 - u0), (y / z - v0) / (v1 - v0), (1 / mpi.near - inverse_t / z) / depth])
    steep = (1 + max(abs(x), abs(y)) / z) * (2 / min(u1 - u0, v1 - v0) + inverse_t / depth)
    return 2 * ndc - 1, float(1 + steep * (reach * inverse_t + 1) / z)


def ndc_to_world(mpi, ndc):
    """World point of an NDC position, or (direction, True) for one on the plane at infinity."""
    u0, u1, v0, v1 = mpi.extent
    u, v = u0 + (ndc[0] + 1) / 2 * (u1 - u0), v0 + (ndc[1] + 1) / 2 * (v1 - v0)
    direction = np.array([u, v, 1.0]) @ np.asarray(mpi.axes, np.float64)
    share = (ndc[2] + 1) / 2
    inverse_depth = (1 - share) / mpi.near + share / mpi.far
    if inverse_depth == 0:
        return direction, True
    return np.asarray(mpi.origin, np.float64) + direction / inverse_depth, False


def cube_samples(cube, step, origin, direction, near=0.0, far=math.inf):
    """Indices i of the positions (i + 1/2) step inside the cube, tested one by one, and the closest decision."""
    lower, upper, direction = np.asarray(cube.lower), np.asarray(cube.upper), np.asarray(direction, np.float64)
    reach = float(np.linalg.norm(origin - (lower + upper) / 2) + np.linalg.norm(upper - lower))
    t = (np.arange(int(reach / step) + 2) + 0.5) * step
    points = origin + t[:, None] * direction
    inside = ((points >= lower) & (points <= upper)).all(-1) & (t >= near) & (t <= far)
    gaps = np.abs(np.concatenate([points - lower, points - upper], -1)[:, np.tile(direction != 0, 2)])
    margin = min(float(gaps.min()), float(np.abs(t - near).min()), float(np.abs(t - far).min())) / reach
    return np.flatnonzero(inside).tolist(), margin


# Lookups and densities -----------------------------------------------------------------------------------------------


def corners(place, shape):
    """(index, weight) of the texels around (u, v) or (u, v, s) in [-1, 1]; corners of the range are texel centres."""
    axes = []
    for x, n in zip(reversed([*place]), shape, strict=True):
        at = min(max((float(x) + 1) / 2 * (n - 1), 0.0), n - 1.0)
        lower = min(math.floor(at), n - 2)
        axes.append(((lower, 1 - (at - lower)), (lower + 1, at - lower)))
    return [(tuple(i for i, _ in c), math.prod(weight for _, weight in c)) for c in itertools.product(*axes)]


def lookup(table, place):
    """Value of an image [H, W, C] at (u, v), or of a volume [D, H, W, C] at (u, v, s)."""
    return sum(weight * table[index] for index, weight in corners(place, table.shape[:-1]))


@functools.cache
def plane_bias(planes):
    """Biases with which all planes start at equal weight, and the interval 256 / L. Solved in decimals."""
    interval = Decimal(256) / planes
    biases = []
    for plane in range(planes):
        alpha = min(1 / Decimal(planes - plane), Decimal("0.999"))
        depth = -_DIGITS.ln(1 - alpha) / interval
        biases.append(float(_DIGITS.ln(_DIGITS.exp(depth) - 1)))
    return np.array(biases), float(interval)


# Blending and compositing --------------------------------------------------------------------------------------------


def shares(reliability, cover, own):
    """Every head's share P (0 where it does not cover), and what the others than ``own`` have together."""
    weights = [_DIGITS.exp(Decimal(float(r))) if c else Decimal(0) for r, c in zip(reliability, cover, strict=True)]
    total, rest = (functools.reduce(_DIGITS.add, w, Decimal(0)) for w in (weights, weights[:own] + weights[own + 1 :]))
    return [_DIGITS.divide(w, total) for w in weights], _DIGITS.divide(rest, total)


def log_shares(reliability, cover, own):
    """log P and log(1 - P); -inf for a sole cover."""
    every, rest = shares(reliability, cover, own)
    return float(_DIGITS.ln(every[own])), -math.inf if rest == 0 else float(_DIGITS.ln(rest))


@dataclass(frozen=True)
class Blended:
    """A sample's optical depth after blending, and its derivatives."""

    depth: float
    by_tau: float
    by_reliability: np.ndarray
    """[H]"""


def blend(tau, reliability, cover, own):
    """-log(1 - alpha') with alpha' = P alpha."""
    every, rest = shares(reliability, cover, own)
    share = every[own]
    # d share / d R_j = share (1 if j is own - P_j)
    slopes = [_DIGITS.multiply(share, (rest if j == own else -p)) for j, p in enumerate(every)]
    clear = _DIGITS.exp(-Decimal(float(tau)))
    passes = _DIGITS.add(rest, _DIGITS.multiply(share, clear))
    opaque = _DIGITS.divide(_DIGITS.subtract(1, clear), passes)
    by_tau = float(_DIGITS.divide(_DIGITS.multiply(share, clear), passes))
    return Blended(float(-_DIGITS.ln(passes)), by_tau, np.array([float(_DIGITS.multiply(s, opaque)) for s in slopes]))


@dataclass(frozen=True)
class Composited:
    """What one ray gathers, sample by sample, nearest first."""

    weights: np.ndarray
    in_front: np.ndarray
    """Transmittance in front of each sample."""
    transmittance: float
    accumulation: float


def composite(taus):
    """Front to back, one sample after the other. taus are optical depths, nearest first."""
    depth, weights, in_front = 0.0, [], []
    for tau in np.asarray(taus, np.float64).tolist():
        in_front.append(math.exp(-depth))
        weights.append(in_front[-1] * -math.expm1(-tau))
        depth += tau
    return Composited(np.array(weights), np.array(in_front), math.exp(-depth), -math.expm1(-depth))


def composite_gradient(taus, by_weight, by_transmittance):
    """d/d tau_i of sum_k by_weight_k w_k + by_transmittance T, back to front.

    A deeper sample i lets T_i e^{-tau_i} less through: its own weight gains that, all weights behind lose themselves.
    """
    made = composite(taus)
    behind = by_transmittance * made.transmittance
    gradient = np.zeros(len(made.weights))
    for i in range(len(gradient) - 1, -1, -1):
        gradient[i] = by_weight[i] * made.in_front[i] * math.exp(-float(taus[i])) - behind
        behind += by_weight[i] * made.weights[i]
    return gradient


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
    taus = [blend(s.tau, s.reliability, s.cover, s.head).depth if blends else s.tau for s in samples]
    gathered = composite(taus)
    color = np.zeros(3)
    for weight, sample in zip(gathered.weights, samples, strict=True):
        color = color + weight * np.asarray(sample.color, np.float64)
    median = median_inverse_distance(list(gathered.weights), [s.inverse_t for s in samples])
    return RenderedRay(samples, gathered.weights, color, gathered.accumulation, gathered.transmittance, median)
