"""Exact geometry, blending and compositing to measure the fast paths against, with exact gradients.

Float64 and 60-digit decimals, one ray at a time, every plane by itself. Shares no code with ``scene/geometry.py``,
``ops``, the sampler or the field: plans come in as plain data.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from decimal import Context, Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.scene.plan import CubePlan, MPIPlan

Array = NDArray[Any]
"""Of float64; numpy's stubs lose that in too many operations to say so."""
FACING = 1e-6
"""Below this cosine between ray and facing direction a ray runs along the planes (the plan's convention)."""
_DIGITS = Context(prec=60, Emax=10**9, Emin=-(10**9))


# Geometry ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Crossings:
    """Where one ray meets the L planes of an MPI, nearest plane first; all [L].

    ``size_uv`` and ``size_q`` are sums of the magnitudes that (u, v) and 1/t are made of: an arithmetic of unit
    roundoff e cannot promise more than a small multiple of e times these.
    """

    live: NDArray[np.bool_]
    inverse_t: Array
    u: Array
    v: Array
    size_uv: Array
    size_q: Array
    margin: Array
    """Distance to the nearest border that decides about ``live``, relative to such a sum."""


def in_frame(mpi: MPIPlan, origin: Array, direction: Array) -> tuple[Array, Array, float]:
    """Origin and direction in the MPI's axes, and the sum of the offset's magnitudes."""
    offset = np.asarray(origin, np.float64) - np.asarray(mpi.origin, np.float64)
    axes = np.asarray(mpi.axes, np.float64)
    reach = float(np.abs(offset).sum())
    return axes @ offset, axes @ np.asarray(direction, np.float64), reach


def cross(mpi: MPIPlan, origin: Array, direction: Array, near: float, far: float) -> Crossings:
    """Intersects a ray with every plane of an MPI."""
    o, d, reach = in_frame(mpi, origin, direction)
    count = mpi.planes
    facing_margin = abs(d[2] - FACING)
    if not d[2] > FACING:
        nothing = np.zeros(count)
        return Crossings(nothing > 0, nothing, nothing, nothing, nothing, nothing, nothing + facing_margin)
    w = disparities(mpi)
    ahead = 1 - w * o[2]
    q = w * d[2] / np.where(ahead != 0, ahead, np.nan)
    u = d[0] / d[2] + w * (o[0] - o[2] * (d[0] / d[2]))
    v = d[1] / d[2] + w * (o[1] - o[2] * (d[1] / d[2]))
    steep = (1 + max(abs(d[0]), abs(d[1])) / d[2]) / d[2]
    size_uv = steep * (1 + w * reach)
    with np.errstate(invalid="ignore", divide="ignore"):
        size_q = np.abs(q) * (1 + 1 / d[2] + w * reach / np.abs(ahead))
    borders = [(u - mpi.extent[0], abs(mpi.extent[0])), (mpi.extent[1] - u, abs(mpi.extent[1]))]
    borders += [(v - mpi.extent[2], abs(mpi.extent[2])), (mpi.extent[3] - v, abs(mpi.extent[3]))]
    tests = [(gap, size_uv + limit) for gap, limit in borders]
    # t >= near and t <= far, both multiplied out so that nothing is divided by zero.
    tests.append((ahead - near * w * d[2], 1 + w * (near + reach)))
    if far < math.inf:
        tests.append((w * d[2] - ahead / far, w + (1 + w * reach) / far))
    tests.append((np.where(ahead > 0, ahead, np.minimum(ahead, -1e-300)), 1 + w * reach))
    live = np.all([gap >= 0 for gap, _ in tests], axis=0)
    margin = np.min([np.abs(gap) / size for gap, size in tests], axis=0)
    return Crossings(live, q, u, v, size_uv, size_q, np.minimum(margin, facing_margin))


def disparities(mpi: MPIPlan) -> Array:
    """1 / depth of every plane, evenly spaced from near to far (or to infinity, 0). [L]"""
    share = np.arange(mpi.planes) / (mpi.planes - 1)
    return (1 - share) / mpi.near + share / mpi.far


def to_ndc(mpi: MPIPlan, u: Array, v: Array, w: Array) -> Array:
    """(u, v, s), each in [-1, 1] over the frustum, from tangents and disparity."""
    u0, u1, v0, v1 = mpi.extent
    s = 2 * (1 / mpi.near - w) / (1 / mpi.near - 1 / mpi.far) - 1
    return np.stack([2 * (u - u0) / (u1 - u0) - 1, 2 * (v - v0) / (v1 - v0) - 1, s], -1)


def place_in(mpi: MPIPlan, origin: Array, direction: Array, inverse_t: float) -> tuple[Array, float] | None:
    """NDC of the point at 1/t along a ray (0: infinity) and the size of its numbers; None behind the MPI."""
    o, d, reach = in_frame(mpi, origin, direction)
    x, y, z = o * inverse_t + d
    if z <= 0:
        return None
    ndc = to_ndc(mpi, *(np.asarray(number) for number in (x / z, y / z, inverse_t / z)))
    widest = 2 / min(mpi.extent[1] - mpi.extent[0], mpi.extent[3] - mpi.extent[2])
    steep = (1 + max(abs(x), abs(y)) / z) * (widest + inverse_t / (1 / mpi.near - 1 / mpi.far))
    return ndc, float(1 + steep * (reach * inverse_t + 1) / z)


def cube_steps(
    cube: CubePlan, step: float, origin: Array, direction: Array, near: float, far: float
) -> tuple[list[int], float]:
    """Indices i of the positions (i + 1/2) step inside the cube, tested one by one, and the closest decision."""
    lower, upper = np.asarray(cube.lower), np.asarray(cube.upper)
    reach = float(np.linalg.norm(origin - (lower + upper) / 2) + np.linalg.norm(upper - lower))
    t = (np.arange(int(reach / step) + 2) + 0.5) * step
    points = origin + t[:, None] * direction
    inside = ((points >= lower) & (points <= upper)).all(-1) & (t >= near) & (t <= far)
    moving = direction != 0
    gaps = np.abs(np.concatenate([points - lower, points - upper], -1)[:, np.concatenate([moving, moving])])
    margin = min(float(gaps.min()), float(np.abs(t - near).min()), float(np.abs(t - far).min())) / reach
    return np.nonzero(inside)[0].tolist(), margin


# Density, blending, compositing --------------------------------------------------------------------------------------


def softplus(x: Array | float) -> Array:
    """log(1 + e^x) without overflow."""
    x = np.asarray(x, np.float64)
    return np.maximum(x, 0) + np.log1p(np.exp(-np.abs(x)))


def sigmoid(x: Array | float) -> Array:
    """Derivative of softplus, without overflow."""
    x = np.asarray(x, np.float64)
    small = np.exp(-np.abs(x))
    return np.where(x >= 0, 1 / (1 + small), small / (1 + small))


@functools.cache
def plane_bias(planes: int, missing: float = 0.0) -> tuple[Array, float]:
    """Biases with which all planes start at equal weight, and the interval 256 / L. Solved in decimals.

    An MPI that ends lacks its last planes (so many, a real number), whose weight is left to what lies behind.
    """
    interval = Decimal(256) / planes
    biases = []
    for plane in range(planes):
        alpha = min(1 / (planes - plane + Decimal(missing)), Decimal("0.999"))
        depth = -_DIGITS.ln(1 - alpha) / interval
        biases.append(float(_DIGITS.ln(_DIGITS.exp(depth) - 1)))
    return np.array(biases), float(interval)


@dataclass(frozen=True)
class Blended:
    """A sample's optical depth after blending, and its derivatives."""

    depth: float
    by_tau: float
    by_reliability: Array
    """[H]"""


def shares(reliability: Array, cover: NDArray[np.bool_], own: int) -> tuple[list[Decimal], Decimal]:
    """Every head's share (0 where it does not cover), and what the others than ``own`` have together."""
    weights = [_DIGITS.exp(Decimal(float(r))) if c else Decimal(0) for r, c in zip(reliability, cover, strict=True)]
    total = Decimal(0)
    rest = Decimal(0)
    for j, weight in enumerate(weights):
        total = _DIGITS.add(total, weight)
        rest = rest if j == own else _DIGITS.add(rest, weight)
    return [_DIGITS.divide(w, total) for w in weights], _DIGITS.divide(rest, total)


def blend(tau: float, reliability: Array, cover: NDArray[np.bool_], own: int, blends: bool) -> Blended:
    """-log(1 - alpha') with alpha' = P alpha, or tau itself."""
    heads = len(cover)
    if not blends:
        return Blended(tau, 1.0, np.zeros(heads))
    every, rest = shares(reliability, cover, own)
    share = every[own]
    # d share / d R_j = share (1 if j is own - P_j)
    slopes = [_DIGITS.multiply(share, (rest if j == own else -p)) for j, p in enumerate(every)]
    depth = Decimal(float(tau))
    clear = _DIGITS.exp(-depth)
    passes = _DIGITS.add(rest, _DIGITS.multiply(share, clear))
    opaque = _DIGITS.divide(1 - clear, passes)
    by = np.array([float(_DIGITS.multiply(s, opaque)) for s in slopes])
    by_tau = float(_DIGITS.divide(_DIGITS.multiply(share, clear), passes))
    return Blended(float(-_DIGITS.ln(passes)), by_tau, by)


@dataclass(frozen=True)
class Composited:
    """What one ray gathers, sample by sample, nearest first."""

    weights: Array
    in_front: Array
    """Transmittance in front of each sample."""
    transmittance: float
    accumulation: float


def composite(taus: Array) -> Composited:
    """Front to back, one sample after the other."""
    depth, weights, in_front = 0.0, [], []
    for tau in np.asarray(taus, np.float64).tolist():
        in_front.append(math.exp(-depth))
        weights.append(in_front[-1] * -math.expm1(-tau))
        depth += tau
    return Composited(np.array(weights), np.array(in_front), math.exp(-depth), -math.expm1(-depth))


def composite_gradient(taus: Array, by_weight: Array, by_transmittance: float) -> Array:
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
