"""One small pure function a loss (paper sec. III-E; weights and normalisations in docs/how_it_works.md)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mmpi_ns.ops.compositing import exclusive_cumsum


def photometric(predicted: Float[Tensor, "R 3"], observed: Float[Tensor, "R 3"]) -> Float[Tensor, ""]:
    """Mean squared colour error over rays and channels (L_pho)."""
    return ((predicted - observed) ** 2).mean()


def point_color(
    mass: Float[Tensor, "R 1"],
    first: Float[Tensor, "R 3"],
    second: Float[Tensor, "R 3"],
    observed: Float[Tensor, "R 3"],
) -> Float[Tensor, ""]:
    """Each sample's own colour against its ray's, weighted by what it contributes (L_pt_rgb; weights held fixed).

    sum_s w_s |c_s - o|^2, mean over rays, from the sums over each ray's samples of w, w c and w c^2.
    """
    error = second - 2 * observed * first + observed**2 * mass
    return error.sum() / max(1, observed.shape[0])


def background_entropy(transmittance: Float[Tensor, "R 1"]) -> Float[Tensor, ""]:
    """Entropy of the mass behind the last sample: a ray ends on something or on nothing (L_bg)."""
    p = transmittance.clamp(1e-6, 1 - 1e-6)
    return -(p * p.log() + (1 - p) * (1 - p).log()).mean()


def distortion(
    weights: Float[Tensor, "R S"], positions: Float[Tensor, "R S"], intervals: Float[Tensor, "R S"]
) -> Float[Tensor, ""]:
    """Spread of a ray's mass (L_dist): sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 delta_i, mean over rays.

    O(S) a ray by prefix sums, which needs ``positions`` sorted along the ray.

    Args:
        weights: rendering weights, 0 in empty slots.
        positions: s, a monotone map of the merged distance into [0, 1].
        intervals: delta, the length each sample stands for on that map.

    Source: mip-NeRF 360 eq. (15); O(N) form as in DVGO v2.
    """
    before = exclusive_cumsum(weights)
    moment_before = exclusive_cumsum(weights * positions)
    between = 2 * (weights * (positions * before - moment_before)).sum(-1)
    within = (weights**2 * intervals).sum(-1) / 3
    return (between + within).mean()


def total_variation(
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


def keypoint_depth(
    weights: Float[Tensor, "R S"],
    inverse_t: Float[Tensor, "R S"],
    known_inverse_t: Float[Tensor, "R 1"],
    valid: Bool[Tensor, "R S"],
    relative_width: float = 0.06,
) -> Float[Tensor, ""]:
    """-log of the weight mass near an SfM keypoint's known inverse distance, mean over the rays that can reach it.

    A soft window exp(-1/2 ((q - q0) / (width q0))^2) in inverse distance q. Rays without a sample within three widths
    say nothing about the point and are left out.

    Args:
        weights: rendering weights of the keypoint rays.
        inverse_t: inverse distances of their samples.
        known_inverse_t: inverse distance of the SfM point; 0 marks a ray without one.
        valid: which slots hold a sample.
        relative_width: standard deviation of the window relative to the known inverse distance.
    """
    scaled = (inverse_t - known_inverse_t) / (relative_width * known_inverse_t.clamp(min=1e-12))
    window = torch.where(valid, torch.exp(-0.5 * scaled**2), torch.zeros_like(scaled))
    reachable = (valid & (scaled.abs() < 3)).any(-1) & (known_inverse_t[:, 0] > 0)
    mass = (weights * window).sum(-1)
    nll = -torch.log(mass + 1e-4)
    count = reachable.sum().clamp(min=1)
    return torch.where(reachable, nll, torch.zeros_like(nll)).sum() / count
