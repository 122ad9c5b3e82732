"""Adam on the rows of a table that a batch touched, or on all of a tensor: DVGO's masked Adam, in place."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.scene.texels import BRICK

AT_LEAST = 4096
"""Rows that justify another thread."""


class AdamConstants(NamedTuple):
    """Constants of one step."""

    beta1: float
    beta2: float
    correction: float | Tensor
    """Root of the second moment's correction: sqrt(1 - beta2^step). On a GPU a tensor [], like the rate, since recorded
    steps are replayed with other values."""
    eps: float
    rate: float | Tensor
    """Learning rate with the first moment's correction: lr / (1 - beta1^step)."""


@operation("gpu")
def adam_rows(
    param: Float[Tensor, "T *C"],
    moments: Float[Tensor, "T 2 *C"],
    rows: Int[Tensor, "U"] | None,
    grad: Float[Tensor, "U *C"],
    constants: AdamConstants,
) -> None:
    """One step of Adam on distinct rows. A table's empty brick and entries whose gradient is exactly 0 do not change.

    Args:
        param: the table.
        moments: mean and uncentred variance of the gradients, in bfloat16 or in the table's precision.
        rows: of the gradient (``Table.grad_rows``); None for those of all of a tensor that is no table.
        grad: of those rows.
        constants: of the step.
    """
    if rows is None:
        for tensor, new in zip((param, moments), adam(param, moments, grad, constants), strict=True):
            tensor.copy_(new)
        return
    grad = grad.masked_fill((rows < BRICK)[:, None], 0)
    new_param, new_moments = adam(param.index_select(0, rows), moments.index_select(0, rows), grad, constants)
    param.index_copy_(0, rows, new_param)
    moments.index_copy_(0, rows, new_moments)


def adam(
    param: Float[Tensor, "N *C"],
    moments: Float[Tensor, "N 2 *C"],
    grad: Float[Tensor, "N *C"],
    constants: AdamConstants,
) -> tuple[Tensor, Tensor]:
    """New values and moments."""
    beta1, beta2, correction, eps, rate = constants
    untouched, (mean, square) = grad == 0, moments.to(param.dtype).unbind(1)
    mean, square = mean.lerp(grad, 1 - beta1), (square * beta2).addcmul_(grad, grad, value=1 - beta2)
    delta = mean / square.sqrt().div_(correction).add_(eps)
    new = torch.stack([mean, square], 1).to(moments.dtype)
    return param - delta.masked_fill_(untouched, 0).mul_(rate), torch.where(untouched[:, None], moments, new)


@adam_rows.on_cpu
def adam_rows_on_cpu(
    param: Tensor, moments: Tensor, rows: Tensor | None, grad: Tensor, constants: AdamConstants
) -> None:
    if rows is None or not param.is_contiguous() or moments.dtype != torch.bfloat16:
        adam_rows.reference(param, moments, rows, grad, constants)
        return
    step = (rows.contiguous(), param.shape[1], grad.contiguous(), param, moments, *map(float, constants))
    call_in_parts("mmpi_adam_rows", len(rows), *step, least=AT_LEAST)
