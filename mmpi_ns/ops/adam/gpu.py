"""Adam on rows on a GPU, in one launch."""

# Triton's language has no types that pyright knows: a kernel's functions seem to return nothing.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

BLOCK = 1024
"""Entries of a program."""


@triton.jit(do_not_specialize=("size",))
def adam_kernel(rows, grads, params, moments, size, channels, beta1, beta2, correction, eps, rate, BLOCK: tl.constexpr):
    """Adam on distinct rows; entries whose gradient is exactly 0 are left alone."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    g = tl.load(grads + i, inside, 0.0)
    touched = g != 0
    row, channel = tl.load(rows + i // channels, inside, 0), i % channels
    at, first = row * channels + channel, moments + 2 * row * channels + channel
    mean = tl.load(first, touched, 0.0).to(tl.float32)
    square = tl.load(first + channels, touched, 0.0).to(tl.float32)
    mean += (1 - beta1) * (g - mean)
    square = square * beta2 + (1 - beta2) * g * g
    step = rate * (mean / (tl.sqrt(square) / correction + eps))
    tl.store(first, mean.to(moments.dtype.element_ty), touched)
    tl.store(first + channels, square.to(moments.dtype.element_ty), touched)
    tl.store(params + at, tl.load(params + at, touched, 0.0) - step, touched)


def adam_rows(param: Tensor, moments: Tensor, rows: Tensor, grad: Tensor, constants: tuple) -> None:
    """See ``ops.adam``."""
    if grad.numel():
        adam_kernel[(triton.cdiv(grad.numel(), BLOCK),)](
            rows.contiguous(), grad.contiguous(), param, moments, grad.numel(), param.shape[1], *constants,
            BLOCK=BLOCK,
        )  # fmt: skip
