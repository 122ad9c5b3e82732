"""Weighted sums of table rows: the gather behind every bilinear and trilinear lookup.

Two paths, one signature: ``interpolate_reference`` in plain indexing, and ``interpolate`` on the embedding-bag kernel
(3 to 6 times faster on a CPU) whose gradient is a sparse row gradient, so that backward and optimiser cost follow the
rows a batch touched, never the size of the table.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor


def interpolate_reference(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """sum_b weights[n, b] table[rows[n, b]], with a dense gradient."""
    return (table[rows] * weights[..., None]).sum(1)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights)
        ctx.table_shape = table.shape
        return torch.nn.functional.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, None, None]:
        rows, weights = ctx.saved_tensors
        values = (grad_outputs[0][:, None, :] * weights[..., None]).reshape(-1, ctx.table_shape[1])
        grad = torch.sparse_coo_tensor(rows.reshape(1, -1), values, ctx.table_shape, check_invariants=False)
        return grad, None, None


def interpolate(
    table: Float[Tensor, "T C"], rows: Int[Tensor, "N B"], weights: Float[Tensor, "N B"]
) -> Float[Tensor, "N C"]:
    """``interpolate_reference`` on a fused kernel. The table's gradient is sparse over rows; weights get none.

    Args:
        table: texels, channels last.
        rows: rows to combine for each output.
        weights: their weights (constants).
    """
    return _Interpolate.apply(table, rows, weights.to(table.dtype))  # type: ignore[no-any-return]
