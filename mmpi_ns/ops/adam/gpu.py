"""Adam on rows of a table on a GPU, in one launch."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops import adam as definition
from mmpi_ns.ops.adam import AdamConstants
from mmpi_ns.ops.gpu_scene import STORED, block_size, launch

ENTRIES = 512
"""Entries per program."""


@triton.jit(do_not_specialize=("count",))
def adam_kernel(
    params, moments, rows, grads, correction, rate, count, channels, new1, keep2, new2, eps,
    ALL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Update of the entries with a gradient other than 0, except for the empty brick; of ALL rows of a tensor."""
    entry = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, number, column = entry < count, entry // channels, entry % channels
    row = number.to(tl.int64) if ALL else tl.load(rows + number, inside, 0)
    grad = tl.load(grads + entry, inside & (ALL | (row >= STORED)), 0.0)
    filled = grad != 0
    at, mean_at = row * channels + column, row * (2 * channels) + column
    mean = tl.load(moments + mean_at, filled, 0.0).to(tl.float32)
    square = tl.load(moments + mean_at + channels, filled, 0.0).to(tl.float32)
    mean = mean + new1 * (grad - mean)
    square = square * keep2 + new2 * grad * grad
    delta = mean / (tl.sqrt(square) / tl.load(correction) + eps)
    tl.store(params + at, tl.load(params + at, filled, 0.0) - delta * tl.load(rate), filled)
    tl.store(moments + mean_at, mean.to(moments.dtype.element_ty), filled)
    tl.store(moments + mean_at + channels, square.to(moments.dtype.element_ty), filled)


def adam_rows(param: Tensor, moments: Tensor, rows: Tensor | None, grad: Tensor, constants: AdamConstants) -> None:
    if not (param.is_contiguous() and moments.is_contiguous()):
        definition.adam_rows.reference(param, moments, rows, grad, constants)
        return
    device, (beta1, beta2, correction, eps, rate) = param.device, constants
    correction, rate = (torch.as_tensor(x, dtype=torch.float32, device=device) for x in (correction, rate))
    block, sizes = block_size(ENTRIES, device), (grad.numel(), grad[0].numel() if len(grad) else 1)
    tensors = (param, moments, grad if rows is None else rows.contiguous(), grad.contiguous(), correction, rate)
    betas = (1 - beta1, beta2, 1 - beta2)
    launch(adam_kernel, sizes[0], block, *tensors, *sizes, *betas, eps, ALL=rows is None, BLOCK=block)
