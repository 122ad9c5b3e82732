"""Adam on rows, compiled: ``adam.cpp``."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from mmpi_ns.ops.adam import reference
from mmpi_ns.ops.build import address, addresses, in_parts, library, sizes


def adam_rows(param: Tensor, moments: Tensor, rows: Tensor, grad: Tensor, constants: tuple) -> None:
    """See ``ops.adam``."""
    if param.ndim != 2 or not param.is_contiguous() or moments.dtype != torch.bfloat16:
        return reference.adam_rows(param, moments, rows, grad, constants)
    rows, grad, lib = rows.contiguous(), grad.contiguous(), library()
    given, tables = address(rows, torch.int64), addresses((grad, param, moments))
    numbers = [ctypes.c_float(x) for x in constants]
    in_parts(
        lambda a, b: lib.mmpi_adam_rows(given, *sizes(a, b, param.shape[1]), *tables, *numbers), len(rows), least=4096
    )
