"""Volume rendering of merged samples (paper sec. III-B): weights, colour, depth, and who won."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.composite.reference import Composite, render_colors

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


@torch.no_grad()
def median_inverse_distance(
    weights: Float[Tensor, "R S"], inverse_t: Float[Tensor, "R S"], valid: Bool[Tensor, "R S"]
) -> Float[Tensor, "R 1"]:
    """1/t of the sample at which a ray has gathered half of what it gathers; 0 (infinity) for an empty ray.

    Depends on one ray alone, so not on how an image is cut into chunks.
    """
    return dispatch.run("median_inverse_distance", weights, inverse_t, valid)


def winning_heads(weights: Float[Tensor, "R S"], heads: Int[Tensor, "R S"], num_heads: int) -> Float[Tensor, "R 1"]:
    """The head that gives each ray most of its weight, as nerfstudio's images take it; the first of equals."""
    return dispatch.run("winning_heads", weights, heads, num_heads)
