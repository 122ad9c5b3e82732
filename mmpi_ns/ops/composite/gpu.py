"""Compositing on a GPU, forward and backward in one launch each; the reference is ``composite_weights``."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops.composite import Composite, composited
from mmpi_ns.ops.gpu_scene import block_size, launch, one_minus_exp

SLOTS = 2048
"""Samples of a program: as many rays as make that many."""


@triton.jit
def _samples(taus, valid, befores, at, inside, slot):
    """Which slots hold a sample, their optical depths, and what lies in front of them."""
    has = tl.load(valid + at, inside, 0) != 0
    # The samples before each one, loaded one slot off: a running sum minus the sample itself would lose small ones.
    earlier = inside & (slot > 0)[None, :]
    earlier = earlier & (tl.load(valid + at - 1, earlier, 0) != 0)
    before = tl.cumsum(tl.load(taus + at - 1, earlier, 0.0), 1) + tl.load(befores + at, inside, 0.0)
    return has, tl.load(taus + at, has, 0.0), before


@triton.jit(do_not_specialize=("num_rays", "slots"))
def composite_kernel(
    taus, valid, befores, totals, weights, depths, num_rays, slots, RAYS: tl.constexpr, SLOTS: tl.constexpr
):
    """Weights of samples and optical depth of rays."""
    ray, slot = tl.program_id(0) * RAYS + tl.arange(0, RAYS), tl.arange(0, SLOTS)
    at = ray[:, None].to(tl.int64) * slots + slot[None, :]
    inside = (ray < num_rays)[:, None] & (slot < slots)[None, :]
    has, tau, before = _samples(taus, valid, befores, at, inside, slot)
    tl.store(weights + at, tl.where(has, tl.exp(-before) * one_minus_exp(tau), 0.0), inside)
    depth = tl.sum(tau, 1) + tl.load(totals + ray, ray < num_rays, 0.0)
    tl.store(depths + ray, depth, ray < num_rays)


@triton.jit(do_not_specialize=("num_rays", "slots"))
def composite_backward_kernel(
    taus, valid, befores, weights, weight_grads, depth_grads, tau_grads, num_rays, slots,
    RAYS: tl.constexpr, SLOTS: tl.constexpr,
):  # fmt: skip
    """d/dtau_j = T_j e^-tau_j g_j - sum_{k > j} w_k g_k + d/ddepth."""
    ray, slot = tl.program_id(0) * RAYS + tl.arange(0, RAYS), tl.arange(0, SLOTS)
    at = ray[:, None].to(tl.int64) * slots + slot[None, :]
    inside = (ray < num_rays)[:, None] & (slot < slots)[None, :]
    has, tau, before = _samples(taus, valid, befores, at, inside, slot)
    direct = tl.exp(-(before + tau)) * tl.load(weight_grads + at, has, 0.0)
    later = inside & (slot + 1 < slots)[None, :]
    later = later & (tl.load(valid + at + 1, later, 0) != 0)
    behind = tl.load(weights + at + 1, later, 0.0) * tl.load(weight_grads + at + 1, later, 0.0)
    depth = tl.load(depth_grads + ray, ray < num_rays, 0.0)[:, None]
    grad = direct - tl.cumsum(behind, 1, reverse=True) + depth
    tl.store(tau_grads + at, tl.where(has, grad, 0.0), inside)


KERNELS = {"mmpi_composite": composite_kernel, "mmpi_composite_back": composite_backward_kernel}


def composite_weights(tau: Tensor, valid: Tensor, skipped_before: Tensor, skipped_total: Tensor) -> Composite:
    width = triton.next_power_of_2(max(16, tau.shape[1]))  # few widths, each of which is compiled
    rays = max(1, block_size(SLOTS, tau.device) // width)

    def run(name: str, num_rays: int, slots: int, *tensors: Tensor) -> None:
        launch(KERNELS[name], num_rays, rays, *tensors, num_rays, slots, RAYS=rays, SLOTS=width)

    return composited(run, tau, valid, skipped_before, skipped_total)
