"""Compositing: ``compositing.composite_weights``, or its fused form on a GPU."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from mmpi_ns import compositing
from mmpi_ns.compositing import Composite
from mmpi_ns.ops import native


def composite_weights(
    tau: Float[Tensor, "R S"],
    valid: Bool[Tensor, "R S"],
    skipped_before: Float[Tensor, "R S"],
    skipped_total: Float[Tensor, "R 1"],
) -> Composite:
    """See ``compositing.composite_weights``; only ``tau`` has gradients."""
    if native.takes_triton(tau):
        from mmpi_ns.ops import triton_composite

        return triton_composite.composite_weights(tau, valid, skipped_before, skipped_total)
    return compositing.composite_weights(tau, valid, skipped_before, skipped_total)
