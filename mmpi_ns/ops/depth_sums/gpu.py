"""Sums for the losses of depth on a GPU: a row of lanes for each ray."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from functools import partial

import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops import depth_sums as definition
from mmpi_ns.ops.composite.gpu import by_rows, slots_of

REACH = tl.constexpr(definition.REACH)


@triton.jit
def _around(weights, inverse_ts, at, inside, scale):
    """Weights of neighbours, and their products with positions."""
    weight = tl.load(weights + at, inside, 0.0)
    return weight, weight / (1 + scale * tl.load(inverse_ts + at, inside, 0.0))


@triton.jit
def _window(inverse_t, targets, ray, exists):
    """Distance from a ray's target in widths of its window, and the target."""
    target, width = tl.load(targets + 2 * ray, exists, 0.0), tl.load(targets + 2 * ray + 1, exists, 1.0)
    return (inverse_t - target) / width, target


@triton.jit(do_not_specialize=("num_rays", "slots"))
def depth_sums_kernel(
    num_rays, slots, scale, valids, weights, inverse_ts, intervals, targets, spreads, masses, reached,
    SLOTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    ray, slot, at, inside = slots_of(tl.program_id(0), num_rays, slots, SLOTS, BLOCK)
    exists, earlier = ray < num_rays, inside & (slot > 0)
    weight, inverse_t = tl.load(weights + at, inside, 0.0), tl.load(inverse_ts + at, inside, 0.0)
    before, moment = _around(weights, inverse_ts, at - 1, earlier, scale)
    position = 1 / (1 + scale * inverse_t)
    apart = weight * (position * tl.cumsum(before, 1) - tl.cumsum(moment, 1))
    interval = tl.load(intervals + ray, exists, 0.0)
    spread = 2 * tl.sum(apart, 1)[:, None] + tl.sum(weight * weight, 1)[:, None] * interval / 3
    scaled, target = _window(inverse_t, targets, ray, exists)
    valid = inside & (tl.load(valids + at, inside, 0) != 0)
    near = tl.where(valid, weight * tl.exp(-0.5 * tl.minimum(scaled * scaled, 120.0)), 0.0)
    reaches = tl.max((valid & (tl.abs(scaled) < REACH)).to(tl.int32), 1)[:, None]
    tl.store(spreads + ray, spread, exists)
    tl.store(masses + ray, tl.sum(near, 1)[:, None], exists)
    tl.store(reached + ray, (reaches > 0) & (target > 0), exists)


@triton.jit(do_not_specialize=("num_rays", "slots", "to_spreads", "to_masses"))
def depth_sums_back_kernel(
    num_rays, slots, scale, valids, weights, inverse_ts, intervals, targets, to_spreads, to_masses, to_weights,
    SLOTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    ray, slot, at, inside = slots_of(tl.program_id(0), num_rays, slots, SLOTS, BLOCK)
    exists, earlier, later = ray < num_rays, inside & (slot > 0), inside & (slot + 1 < slots)
    weight, inverse_t = tl.load(weights + at, inside, 0.0), tl.load(inverse_ts + at, inside, 0.0)
    position = 1 / (1 + scale * inverse_t)
    before, moment = _around(weights, inverse_ts, at - 1, earlier, scale)
    behind, far_moment = _around(weights, inverse_ts, at + 1, later, scale)
    apart = position * tl.cumsum(before, 1) - tl.cumsum(moment, 1)
    apart += tl.cumsum(far_moment, 1, reverse=True) - position * tl.cumsum(behind, 1, reverse=True)
    slope = 2 * apart + 2 * weight * tl.load(intervals + ray, exists, 0.0) / 3
    slope = slope * tl.load(to_spreads + ray, exists, 0.0)
    scaled, _ = _window(inverse_t, targets, ray, exists)
    valid = inside & (tl.load(valids + at, inside, 0) != 0)
    near = tl.where(valid, tl.exp(-0.5 * tl.minimum(scaled * scaled, 120.0)), 0.0)
    tl.store(to_weights + at, slope + near * tl.load(to_masses + ray, exists, 0.0), inside)


def depth_sums(
    weights: Tensor, inverse_t: Tensor, valid: Tensor, intervals: Tensor, targets: Tensor, scale: float
) -> definition.DepthSums:
    run, back = (partial(by_rows, kernel) for kernel in (depth_sums_kernel, depth_sums_back_kernel))
    return definition.compiled_sums(run, back, weights, inverse_t, valid, intervals, targets, scale)
