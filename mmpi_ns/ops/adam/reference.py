"""Adam that leaves entries alone whose gradient is exactly 0 (DVGO's masked Adam), in plain torch."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.scene.texels import BRICK


def adam_rows(param: Tensor, moments: Tensor, rows: Tensor, grad: Tensor, constants: tuple) -> None:
    """See ``ops.adam``."""
    grad = grad.masked_fill((rows < BRICK)[:, None], 0)
    new_param, new_moments = adam(param.index_select(0, rows), moments.index_select(0, rows), grad, constants)
    param.index_copy_(0, rows, new_param)
    moments.index_copy_(0, rows, new_moments)


def adam(
    param: Float[Tensor, "N *C"], moments: Float[Tensor, "N 2 *C"], grad: Float[Tensor, "N *C"], constants: tuple
) -> tuple[Tensor, Tensor]:
    """New values and moments; ``constants`` as ``ops.adam.AdamConstants``."""
    beta1, beta2, correction, eps, rate = constants
    touched, (mean, square) = grad != 0, moments.to(param.dtype).unbind(1)
    mean = torch.where(touched, mean.lerp(grad, 1 - beta1), mean)
    square = torch.where(touched, (square * beta2).addcmul_(grad, grad, value=1 - beta2), square)
    delta = mean / square.sqrt().div_(correction).add_(eps)
    delta = torch.where(touched, delta, torch.zeros_like(delta))
    return param - delta.mul_(rate), torch.stack([mean, square], 1).to(moments.dtype)
