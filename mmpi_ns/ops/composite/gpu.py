"""Compositing on a GPU: a row of lanes for each ray, in one launch, and its gradient in another."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from functools import partial
from typing import Any

import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.composite import Composite, compiled_weights
from mmpi_ns.ops.gpu_scene import block_size, launch, one_minus_exp

NUMBERS = 512
"""Slots per program."""


@triton.jit
def slots_of(row, num_rays, slots, SLOTS: tl.constexpr, BLOCK: tl.constexpr):
    """Rays of a program, their slots, the addresses of these, and which exist."""
    ray, slot = (row * BLOCK + tl.arange(0, BLOCK))[:, None], tl.arange(0, SLOTS)[None, :]
    return ray, slot, ray.to(tl.int64) * slots + slot, (ray < num_rays) & (slot < slots)


@triton.jit
def _transmittance(taus, valids, befores, slot, at, inside):
    """Optical depth of each slot, the transmittance before it, and which slots hold a sample."""
    valid = inside & (tl.load(valids + at, inside, 0) != 0)
    earlier = inside & (slot > 0)
    earlier = earlier & (tl.load(valids + at - 1, earlier, 0) != 0)
    passed = tl.cumsum(tl.load(taus + at - 1, earlier, 0.0), 1)  # summed, not subtracted
    return tl.load(taus + at, valid, 0.0), tl.exp(-(passed + tl.load(befores + at, valid, 0.0))), valid


@triton.jit(do_not_specialize=("num_rays", "slots"))
def composite_kernel(
    num_rays, slots, taus, valids, befores, totals, weights, depths, SLOTS: tl.constexpr, BLOCK: tl.constexpr
):
    """Weights of samples, and optical depths of rays."""
    ray, slot, at, inside = slots_of(tl.program_id(0), num_rays, slots, SLOTS, BLOCK)
    tau, transmittance, valid = _transmittance(taus, valids, befores, slot, at, inside)
    tl.store(weights + at, tl.where(valid, transmittance * one_minus_exp(tau), 0.0), inside)
    depth = tl.sum(tau, 1)[:, None]
    tl.store(depths + ray, depth + tl.load(totals + ray, ray < num_rays, 0.0), ray < num_rays)


@triton.jit(do_not_specialize=("num_rays", "slots", "to_weights", "to_depths"))
def composite_back_kernel(
    num_rays, slots, taus, valids, befores, weights, to_weights, to_depths, to_taus,
    SLOTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of optical depths."""
    ray, slot, at, inside = slots_of(tl.program_id(0), num_rays, slots, SLOTS, BLOCK)
    tau, transmittance, valid = _transmittance(taus, valids, befores, slot, at, inside)
    later = inside & (slot + 1 < slots)
    hidden = tl.load(weights + at + 1, later, 0.0) * tl.load(to_weights + at + 1, later, 0.0)
    slope = transmittance * tl.exp(-tau) * tl.load(to_weights + at, valid, 0.0) - tl.cumsum(hidden, 1, reverse=True)
    slope += tl.load(to_depths + ray, ray < num_rays, 0.0)
    tl.store(to_taus + at, tl.where(valid, slope, 0.0), inside)


def by_rows(kernel: Any, num_rays: int, slots: int, *values: Any) -> None:
    """Runs a kernel that has a row of lanes for each ray: with these numbers, inputs and outputs."""
    columns = int(triton.next_power_of_2(max(1, slots)))
    block = block_size(max(1, NUMBERS // columns), next(x.device for x in values if isinstance(x, Tensor)))
    launch(kernel, num_rays, block, num_rays, slots, *values, SLOTS=columns, BLOCK=block)


def composite_weights(tau: Tensor, valid: Tensor, skipped_before: Tensor, skipped_total: Tensor) -> Composite:
    run, back = (partial(by_rows, kernel) for kernel in (composite_kernel, composite_back_kernel))
    return compiled_weights(run, back, tau, valid, skipped_before, skipped_total)
