"""Volume rendering of merged samples (paper sec. III-B): weights, colour, depth, and who won."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.composite.reference import Composite, median_inverse_distance, render_colors, winning_heads

__all__ = ["Composite", "composite_weights", "median_inverse_distance", "render_colors", "winning_heads"]


def composite_weights(
    tau: Float[Tensor, "R S"],
    valid: Bool[Tensor, "R S"],
    skipped_before: Float[Tensor, "R S"],
    skipped_total: Float[Tensor, "R 1"],
) -> Composite:
    """Volume-rendering weights of merged samples, sorted by distance; with gradients to ``tau``.

    Args:
        tau: blended optical depths of the samples that were kept.
        valid: which slots hold a sample.
        skipped_before: optical depth of the dropped samples in front of each kept one (a constant).
        skipped_total: optical depth of all dropped samples of the ray.

    Returns:
        Weights T_k (1 - exp(-tau_k)), accumulation and remaining transmittance.

    Source: paper eq. (rendering) and its blended form in sec. III-C.
    """
    return dispatch.run("composite_weights", tau, valid, skipped_before, skipped_total)
