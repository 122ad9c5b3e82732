"""Adam on rows, compiled: ``adam.cpp``."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops.adam import reference
from mmpi_ns.ops.build import call_in_parts


def adam_rows(param: Tensor, moments: Tensor, rows: Tensor, grad: Tensor, constants: tuple) -> None:
    """See ``ops.adam``."""
    if not param.is_contiguous() or moments.dtype != torch.bfloat16:
        return reference.adam_rows(param, moments, rows, grad, constants)
    after = (param.shape[1], grad.contiguous(), param, moments, *map(float, constants))
    call_in_parts("mmpi_adam_rows", len(rows), (rows.contiguous(),), after, least=4096)
