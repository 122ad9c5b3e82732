"""Adam that leaves entries alone whose gradient is exactly 0 (DVGO's masked Adam), in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def adam_rows(param: Tensor, mean: Tensor, square: Tensor, rows: Tensor, grad: Tensor, constants: tuple) -> None:
    """See ``ops.adam``."""
    new = adam(param.index_select(0, rows), mean.index_select(0, rows), square.index_select(0, rows), grad, constants)
    for table, fresh in zip((param, mean, square), new, strict=True):
        table.index_copy_(0, rows, fresh)


def adam(param: Tensor, mean: Tensor, square: Tensor, grad: Tensor, constants: tuple) -> tuple[Tensor, Tensor, Tensor]:
    """New values and moments of entries of any shape; ``constants`` as ``ops.adam.AdamConstants``."""
    beta1, beta2, correction, eps, rate = constants
    touched = grad != 0
    mean = torch.where(touched, mean.lerp(grad, 1 - beta1), mean)
    square = torch.where(touched, (square * beta2).addcmul_(grad, grad, value=1 - beta2), square)
    delta = mean / square.sqrt().div_(correction).add_(eps)
    delta = torch.where(touched, delta, torch.zeros_like(delta))
    return param - delta.mul_(rate), mean, square
