"""Adam on rows on a GPU, in one launch."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from mmpi_ns.ops import adam
from mmpi_ns.ops.gpu_scene import launch
from mmpi_ns.scene.texels import BRICK

BLOCK = 1024
"""Entries of a program."""


@triton.jit
def _widen(half):
    """Numbers in bfloat16 are the upper halves of floats."""
    return (half.to(tl.int32) << 16).to(tl.float32, bitcast=True)


@triton.jit
def _narrow(x):
    """The nearest number in bfloat16, of two the even one. By hand: Triton's interpreter cuts the lower half off."""
    bits = x.to(tl.int32, bitcast=True)
    return ((bits + 0x7FFF + ((bits >> 16) & 1)) >> 16).to(tl.int16)


@triton.jit(do_not_specialize=("size",))
def adam_kernel(
    rows, grads, params, moments, size, channels, beta1, beta2, correction, eps, rate,
    EMPTY: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adam on distinct rows; those of the empty brick, and entries whose gradient is exactly 0, are left alone."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    g = tl.load(grads + i, inside, 0.0)
    row, channel = tl.load(rows + i // channels, inside, 0), i % channels
    touched = (g != 0) & (row >= EMPTY)
    at, first = row * channels + channel, moments + 2 * row * channels + channel
    mean, square = _widen(tl.load(first, touched, 0)), _widen(tl.load(first + channels, touched, 0))
    mean += (1 - beta1) * (g - mean)
    square = square * beta2 + (1 - beta2) * g * g
    step = rate * (mean / (tl.sqrt(square) / correction + eps))
    tl.store(first, _narrow(mean), touched)
    tl.store(first + channels, _narrow(square), touched)
    tl.store(params + at, tl.load(params + at, touched, 0.0) - step, touched)


def adam_rows(param: Tensor, moments: Tensor, rows: Tensor, grad: Tensor, constants: adam.AdamConstants) -> None:
    if moments.dtype != torch.bfloat16:
        return adam.adam_rows.reference(param, moments, rows, grad, constants)
    tensors, size = (rows.contiguous(), grad.contiguous(), param, moments.view(torch.int16)), grad.numel()
    launch(adam_kernel, size, BLOCK, *tensors, size, param.shape[1], *constants, EMPTY=BRICK, BLOCK=BLOCK)
