"""Adam on the rows of a table that a batch touched, in place."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.shapes import check_shapes


class AdamConstants(NamedTuple):
    """Of one step."""

    beta1: float
    beta2: float
    correction: float
    """Root of the second moment's: sqrt(1 - beta2^step)."""
    eps: float
    rate: float
    """With the first moment's correction: lr / (1 - beta1^step)."""


def adam_rows(
    param: Float[Tensor, "T C"],
    moments: Float[Tensor, "T 2 C"],
    rows: Int[Tensor, "U"],
    grad: Float[Tensor, "U C"],
    constants: AdamConstants,
) -> None:
    """One step of Adam on distinct rows. The empty brick, and entries whose gradient is exactly 0, are left alone.

    Args:
        param: the table.
        moments: mean and uncentred variance of the gradients, in bfloat16 or in the table's precision.
        rows: of the gradient (``Table.grad_rows``).
        grad: of those rows.
        constants: of the step.
    """
    check_shapes("param T C, moments T 2 C, rows U, grad U C", param, moments, rows, grad)
    dispatch.run("adam_rows", param, moments, rows, grad, constants)
