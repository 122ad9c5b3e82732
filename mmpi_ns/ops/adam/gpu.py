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

NUMBERS = 512
"""Entries per program."""


@triton.jit(do_not_specialize=("count",))
def adam_kernel(
    params, moments, rows, grads, correction, rate, count, channels, new1, keep2, new2, eps,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Update of the entries with a gradient other than 0, except for the empty brick."""
    number, column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, CHANNELS)[None, :]
    row = tl.load(rows + number, number < count, 0)
    filled = ((number < count) & (row >= STORED))[:, None] & (column < channels)
    grad = tl.load(grads + number.to(tl.int64)[:, None] * channels + column, filled, 0.0)
    filled = filled & (grad != 0)
    at, mean_at = row[:, None] * channels + column, row[:, None] * (2 * channels) + column
    mean = tl.load(moments + mean_at, filled, 0.0).to(tl.float32)
    square = tl.load(moments + mean_at + channels, filled, 0.0).to(tl.float32)
    mean = mean + new1 * (grad - mean)
    square = square * keep2 + new2 * grad * grad
    delta = mean / (tl.sqrt(square) / tl.load(correction) + eps)
    tl.store(params + at, tl.load(params + at, filled, 0.0) - delta * tl.load(rate), filled)
    tl.store(moments + mean_at, mean.to(moments.dtype.element_ty), filled)
    tl.store(moments + mean_at + channels, square.to(moments.dtype.element_ty), filled)


def adam_rows(param: Tensor, moments: Tensor, rows: Tensor, grad: Tensor, constants: AdamConstants) -> None:
    if not (param.is_contiguous() and moments.is_contiguous()):
        definition.adam_rows.reference(param, moments, rows, grad, constants)
        return
    channels, device, (beta1, beta2, correction, eps, rate) = param.shape[1], param.device, constants
    correction, rate = (torch.as_tensor(x, dtype=torch.float32, device=device) for x in (correction, rate))
    columns = triton.next_power_of_2(channels)
    block = block_size(max(32, NUMBERS // columns), device)
    betas = (1 - beta1, beta2, 1 - beta2)
    tensors = (param, moments, rows.contiguous(), grad.contiguous(), correction, rate)
    launch(adam_kernel, len(rows), block, *tensors, len(rows), channels, *betas, eps, CHANNELS=columns, BLOCK=block)
