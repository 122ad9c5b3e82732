"""Total variation, compiled: ``variation.cpp``, value and gradient in one pass."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.cpu_scene import grids_of
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.ops.variation import Scales, WithGradient

PART = 4096
"""Texels whose differences are summed together, so that a sum does not depend on the threads."""


def total_variation(values: Tensor, table: Tensor, rows: Tensor, layout: SceneLayout, scales: Scales) -> Tensor:
    gradient, totals = torch.empty_like(values), torch.zeros(-(-len(rows) // PART), dtype=torch.float64)
    inputs = (rows.contiguous(), len(rows), table.shape[1], table, len(table), grids_of(layout), layout.num_heads)
    weights = torch.tensor(scales, dtype=torch.float32)
    outputs = (gradient, totals)
    places = layout.grids[0].places
    call_in_parts("mmpi_total_variation", len(totals), *inputs, places, weights, *outputs, least=1)
    return WithGradient.apply(values, totals.sum().to(values.dtype), gradient)  # type: ignore[no-any-return]
