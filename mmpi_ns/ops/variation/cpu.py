"""Total variation, compiled: ``variation.cpp``, value and gradient in one pass."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from mmpi_ns.ops.build import address, in_parts, library, sizes
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.ops.variation.reference import Scales

PART = 4096
"""Texels whose differences are summed together, so that a sum does not depend on the threads."""


class _Variation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, table: Tensor, rows: Tensor, layout: SceneLayout, scales: Scales) -> Tensor:
        gradient, grids, lib = torch.empty_like(values), CpuScene.of(layout).grids, library()
        flat = [s for each in scales for s in each]
        totals = torch.zeros(-(-len(rows) // PART), dtype=torch.float64)
        given = (address(table), *sizes(len(table)), grids, *sizes(len(grids)))
        given = (*given, address(layout.grids[0].places, torch.int64), (ctypes.c_float * len(flat))(*flat))
        made, where = (address(gradient), address(totals, torch.float64)), address(rows, torch.int64)

        def part(begin: int, end: int) -> None:
            lib.mmpi_total_variation(where, *sizes(len(rows), begin, end, table.shape[1]), *given, *made)

        in_parts(part, len(totals), least=1)
        ctx.save_for_backward(gradient)
        return totals.sum().to(values.dtype)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.saved_tensors[0] * grad_outputs[0], None, None, None, None


def total_variation(values: Tensor, table: Tensor, rows: Tensor, layout: SceneLayout, scales: Scales) -> Tensor:
    """See ``ops.variation``."""
    return _Variation.apply(values, table, rows.contiguous(), layout, scales)  # type: ignore[no-any-return]
