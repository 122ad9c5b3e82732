"""Total variation of the texels that a batch touched (paper sec. III-E, L_TV)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.gather import COLORS
from mmpi_ns.ops.layout import SceneLayout, dense


@operation("gpu")
def total_variation(
    values: Float[Tensor, "U C"],
    table: Float[Tensor, "T C"],
    rows: Int[Tensor, "U"],
    layout: SceneLayout,
    scales: Float[Tensor, "H 3"],
    chroma: float = 0.0,
) -> Float[Tensor, ""]:
    """Huber loss of the differences of distinct texels with their stored neighbours in the same head.

    Args:
        values: the texels, gathered from the table; with gradients.
        table: the pooled table (held fixed).
        rows: of these texels in the table, those of a brick together; none beyond the border of a plane.
        layout: of the scene.
        scales: weight of a difference along x, y and z, of each head.
        chroma: additional factor on the gradient of chroma.
    """
    total = values.new_zeros(())
    if chroma > 0 and values.requires_grad:
        values = values.view_as(values)  # a node of its own: the hook sees this loss's gradient alone
        values.register_hook(lambda gradient: weigh_chroma(gradient, chroma))
    for grid, each in zip(layout.grids, scales, strict=True):
        inside = grid.holds(rows).nonzero()[:, 0]
        neighbours, exists = grid.neighbours(rows[inside])
        weights = exists * each.repeat_interleave(2)
        total = total + clamped_differences(values[inside], table[neighbours], weights)
    return total


def weigh_chroma(gradient: Float[Tensor, "N C"], times: float) -> Float[Tensor, "N C"]:
    """Gradients of texels, with the part along chroma (three colours less their mean) weighted ``times`` times more."""
    colors = gradient[:, :COLORS]
    return torch.cat([colors + times * (colors - colors.mean(-1, keepdim=True)), gradient[:, COLORS:]], -1)


def clamped_differences(
    values: Float[Tensor, "N C"], neighbours: Float[Tensor, "N M C"], scales: Float[Tensor, "N M"]
) -> Float[Tensor, ""]:
    """Sum of clamped neighbour differences, whose gradient is DVGO's (L_TV).

    DVGO adds ``scale / 6 * clamp(v - v_neighbour, -1, 1)`` to the gradient of each touched texel. That is the gradient
    of a Huber function of the difference with the neighbour held fixed, here an ordinary loss.

    Args:
        values: texels that the batch touched, one row each.
        neighbours: their neighbours along each axis (held fixed).
        scales: weight of each difference (resolution / 128, 0 where there is no neighbour).
    """
    difference = values[:, None, :] - neighbours.detach()
    size = difference.abs()
    huber = torch.where(size <= 1, 0.5 * difference**2, size - 0.5)
    return (scales[..., None] * huber).sum() / 6


class WithGradient(torch.autograd.Function):
    """A loss with a precomputed gradient, for one backward pass."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, loss: Tensor, gradient: Tensor) -> Tensor:
        ctx.gradient = gradient
        return loss

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        gradient, ctx.gradient = ctx.gradient, None  # scaled in place, as it is as large as the batch's texels
        return gradient.mul_(grad_outputs[0]), None, None


PART = 4096
"""Texels per partial sum, so that sums do not depend on the threads."""


@total_variation.on_cpu
def total_variation_on_cpu(
    values: Tensor, table: Tensor, rows: Tensor, layout: SceneLayout, scales: Tensor, chroma: float = 0.0
) -> Tensor:
    gradient, totals = torch.empty_like(values), torch.zeros(-(-len(rows) // PART), dtype=torch.float64)
    inputs = (rows.contiguous(), len(rows), table.shape[1], table, len(table), layout.cpu_grids, layout.num_heads)
    weights, outputs = (*dense(scales), float(chroma)), (gradient, totals)
    places = layout.grids[0].places
    call_in_parts("mmpi_total_variation", len(totals), *inputs, places, *weights, *outputs, least=1)
    return WithGradient.apply(values, totals.sum().to(values.dtype), gradient)  # type: ignore[no-any-return]
