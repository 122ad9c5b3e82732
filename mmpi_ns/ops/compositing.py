"""Merged transmittance in log space, blended by reliability (paper sec. III-B and III-C).

A sample is carried by its optical depth tau = -log(1 - alpha), never by alpha: alpha = 1 is an infinite slope of
log(1 - alpha), while tau is an ordinary number. All arithmetic is float32 or wider, also under autocast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

BlendForm = Literal["paper", "opacity"]
"""paper: alpha' = P alpha. opacity: 1 - alpha' = (1 - alpha)^P, which keeps opaque copies opaque."""


def exclusive_cumsum(values: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """Sum of all earlier samples on the ray. Shifted, not subtracted: x - x loses what came before a large x."""
    shifted = torch.nn.functional.pad(values[:, :-1], (1, 0))
    return shifted.cumsum(-1)


def blend_shares(
    reliability: Float[Tensor, "N H"], cover: Bool[Tensor, "N H"], own: Int[Tensor, "N"]
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """log P and log(1 - P) of each sample's own head among the heads that cover it.

    Args:
        reliability: R of every head at the sample's position; what uncovered heads hold is ignored.
        cover: which heads cover the position; a sample's own head must be among them.
        own: the head a sample was taken from.

    Returns:
        log softmax over the covering heads at ``own``, and the log of its complement (-inf for a sole cover).

    Source: paper sec. III-C, P_i = exp(R_i) / sum_j exp(R_j). log(1 - P) comes from the other heads directly:
    from P itself it is wrong beyond R = 17 and has a NaN gradient at P = 1.
    """
    reliability = reliability.float() if reliability.dtype in (torch.float16, torch.bfloat16) else reliability
    lowest = torch.finfo(reliability.dtype).min
    # Only differences matter, and they are exact only where the numbers are small: the highest becomes 0.
    highest = torch.where(cover, reliability, torch.full_like(reliability, lowest)).amax(-1, keepdim=True).detach()
    reliability = reliability - highest
    is_own = torch.arange(cover.shape[-1], device=cover.device) == own[:, None]
    own_value = torch.where(is_own, reliability, torch.zeros_like(reliability)).sum(-1)
    others = cover & ~is_own
    has_others = others.any(-1)
    # A row without others would be a logsumexp over nothing: give it a harmless row and mask the result.
    other_values = torch.where(others, reliability, torch.full_like(reliability, lowest))
    other_values = torch.where(has_others[:, None], other_values, torch.zeros_like(other_values))
    odds = torch.logsumexp(other_values, -1) - own_value
    # As softplus both logs and both slopes are exact at P near 0 and 1; differences with the sum of all cancel there.
    log_share = torch.where(has_others, -_softplus(odds), torch.zeros_like(odds))
    log_rest = torch.where(has_others, -_softplus(-odds), torch.full_like(odds, -torch.inf))
    return log_share, log_rest


def _softplus(x: Tensor) -> Tensor:
    """log(1 + e^x); torch's own returns x from 20 on, which float64 can tell from it."""
    return torch.nn.functional.softplus(x, threshold=50)


def blended_optical_depth(
    tau: Float[Tensor, "N"],
    log_share: Float[Tensor, "N"],
    log_rest: Float[Tensor, "N"],
    form: BlendForm = "paper",
) -> Float[Tensor, "N"]:
    """-log(1 - alpha') of a sample after blending; exactly tau where it is the sole cover.

    Source: paper sec. III-C, alpha' = P alpha, so 1 - alpha' = (1 - P) + P (1 - alpha).
    """
    if form == "opacity":
        return tau * log_share.exp()
    sole = torch.isneginf(log_rest)
    # Two forms of one number: the first is exact for thin samples (and 0 for empty ones), the second for opaque ones.
    alpha = -torch.expm1(-tau) * log_share.exp()
    thin = alpha < 0.5
    log1p = torch.log1p(-torch.where(thin, alpha, torch.zeros_like(alpha)))
    safe_rest = torch.where(sole, torch.zeros_like(log_rest), log_rest)
    blended = -torch.where(thin, log1p, torch.logaddexp(safe_rest, log_share - tau))
    return torch.where(sole, tau, blended.clamp(min=0))


@dataclass(frozen=True)
class Composite:
    """What a ray has gathered. All values are per ray, weights per sample."""

    weights: Float[Tensor, "R S"]
    """T_k alpha'_k of the samples that were kept."""
    accumulation: Float[Tensor, "R 1"]
    """1 - transmittance behind the last sample, the dropped ones included."""
    transmittance: Float[Tensor, "R 1"]
    """What passes the whole ray."""


def composite_weights(
    tau: Float[Tensor, "R S"],
    valid: Bool[Tensor, "R S"],
    skipped_before: Float[Tensor, "R S"],
    skipped_total: Float[Tensor, "R 1"],
) -> Composite:
    """Volume-rendering weights of merged samples, sorted by distance.

    Args:
        tau: blended optical depths of the samples that were kept.
        valid: which slots hold a sample.
        skipped_before: optical depth of the dropped samples in front of each kept one (a constant).
        skipped_total: optical depth of all dropped samples of the ray.

    Returns:
        Weights T_k (1 - exp(-tau_k)), accumulation and remaining transmittance.

    Source: paper eq. (rendering) and its blended form in sec. III-C.
    """
    tau = torch.where(valid, tau, torch.zeros_like(tau))
    log_transmittance = -(exclusive_cumsum(tau) + skipped_before)
    weights = torch.exp(log_transmittance) * -torch.expm1(-tau)
    weights = torch.where(valid, weights, torch.zeros_like(weights))
    depth = tau.sum(-1, keepdim=True) + skipped_total
    return Composite(weights, -torch.expm1(-depth), torch.exp(-depth))


def render_colors(composite: Composite, colors: Float[Tensor, "R S 3"]) -> Float[Tensor, "R 3"]:
    """Colour gathered along each ray, without background.

    The mass of dropped samples is given the mean colour of those kept (a constant factor per ray), so that dropping
    does not darken the image.
    """
    return fill_up(composite, (composite.weights[..., None] * colors).sum(-2))


def fill_up(composite: Composite, gathered: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """What the samples that were kept have gathered, for all that there are."""
    kept = composite.weights.sum(-1, keepdim=True)
    factor = torch.where(kept > 1e-6, composite.accumulation / kept.clamp(min=1e-6), torch.ones_like(kept))
    return factor.detach() * gathered


def median_inverse_distance(
    weights: Float[Tensor, "R S"], inverse_t: Float[Tensor, "R S"], valid: Bool[Tensor, "R S"]
) -> Float[Tensor, "R 1"]:
    """1/t of the sample at which a ray has gathered half of what it gathers; 0 (infinity) for an empty ray.

    Depends on one ray alone, so not on how an image is cut into chunks.
    """
    gathered = weights.cumsum(-1)
    total = gathered[:, -1:]
    reached = (gathered >= 0.5 * total) & valid & (total > 0)
    index = reached.to(torch.int8).argmax(-1, keepdim=True)
    picked = inverse_t.gather(-1, index)
    return torch.where(reached.any(-1, keepdim=True), picked, torch.zeros_like(picked))
