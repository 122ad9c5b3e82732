"""Total variation, compiled: ``variation.cpp``, value and gradient in one pass."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.ops.variation.reference import Scales

PART = 4096
"""Texels whose differences are summed together, so that a sum does not depend on the threads."""


class _Variation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, table: Tensor, rows: Tensor, layout: SceneLayout, scales: Scales) -> Tensor:
        gradient, grids = torch.empty_like(values), CpuScene.of(layout).grids
        weights = torch.tensor(scales, dtype=torch.float32)
        totals = torch.zeros(-(-len(rows) // PART), dtype=torch.float64)
        inputs = (table.shape[1], table, len(table), grids, len(grids), layout.grids[0].places, weights)
        call_in_parts("mmpi_total_variation", len(totals), (rows, len(rows)), (*inputs, gradient, totals), least=1)
        ctx.save_for_backward(gradient)
        return totals.sum().to(values.dtype)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.saved_tensors[0] * grad_outputs[0], None, None, None, None


def total_variation(values: Tensor, table: Tensor, rows: Tensor, layout: SceneLayout, scales: Scales) -> Tensor:
    """See ``ops.variation``."""
    return _Variation.apply(values, table, rows.contiguous(), layout, scales)  # type: ignore[no-any-return]
