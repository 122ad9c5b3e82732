"""Total variation of texels in plain torch."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.ops.layout import SceneLayout

Scales = list[tuple[float, float, float]]


def total_variation(values: Tensor, table: Tensor, rows: Tensor, layout: SceneLayout, scales: Scales) -> Tensor:
    """See ``ops.variation``."""
    total = values.new_zeros(())
    for grid, each in zip(layout.grids, scales, strict=True):
        inside = grid.holds(rows).nonzero()[:, 0]
        neighbours, exists = grid.neighbours(rows[inside])
        weights = exists * torch.tensor([s for s in each for _ in range(2)], device=rows.device)
        around = table[neighbours.reshape(-1)].view(*neighbours.shape, -1)
        total = total + clamped_differences(values[inside], around, weights)
    return total


def clamped_differences(
    values: Float[Tensor, "N C"], neighbours: Float[Tensor, "N M C"], scales: Float[Tensor, "N M"]
) -> Float[Tensor, ""]:
    """Sum of clamped neighbour differences, whose gradient is DVGO's (L_TV).

    DVGO adds ``scale / 6 * clamp(v - v_neighbour, -1, 1)`` to the gradient of each touched texel. That is the gradient
    of a Huber function of the difference with the neighbour held fixed, so it is an ordinary loss here.

    Args:
        values: texels that the batch touched, one row each.
        neighbours: their neighbours along each axis (held fixed).
        scales: weight of each difference (resolution / 128, 0 where there is no neighbour).
    """
    difference = values[:, None, :] - neighbours.detach()
    size = difference.abs()
    huber = torch.where(size <= 1, 0.5 * difference**2, size - 0.5)
    return (scales[..., None] * huber).sum() / 6
