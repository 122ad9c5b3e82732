"""Adam on rows, compiled: ``adam.cpp``."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops import adam
from mmpi_ns.ops.build import call_in_parts


def adam_rows(param: Tensor, moments: Tensor, rows: Tensor, grad: Tensor, constants: adam.AdamConstants) -> None:
    if not param.is_contiguous() or moments.dtype != torch.bfloat16:
        return adam.adam_rows.reference(param, moments, rows, grad, constants)
    step = (rows.contiguous(), param.shape[1], grad.contiguous(), param, moments, *map(float, constants))
    call_in_parts("mmpi_adam_rows", len(rows), *step, least=4096)
