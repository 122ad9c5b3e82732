"""The losses: each a small pure function, and their weighted sum for a training batch (paper sec. III-E, SfM depth).

Weights and normalisations: docs/how_it_works.md. Total variation is computed on the tables (``ops/variation.py``).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mmpi_ns.capture.ray_sources import EXPOSURE, KEYPOINT_DEPTH, PIXEL_DEPTH
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import metadata_of
from mmpi_ns.ops.composite.reference import Composite, exclusive_cumsum
from mmpi_ns.rendering.rendered import RenderedRays

CLIPPED = 0.98
"""Colour of an image above which a channel may be clipped."""
PLANE_ERROR = 0.6
"""Minimum error of a known depth, in plane spacings."""


@dataclass
class LossWeights:
    """Weights of the losses added to the photometric one."""

    point_color: float = 0.01
    """Colour of each sample against its ray's."""
    background_entropy: float = 0.001
    """Entropy of the transmittance of a ray."""
    distortion: float = 0.01
    """Spread of a ray's weights over distance (distortion)."""
    keypoint_depth: float = 0.02
    """-log of the weights near an SfM keypoint (scenes with tracks)."""
    known_depth: float = 0.01
    """-log of the likelihood of a pixel's known depth, from dense matches, an SfM point or a sensor."""
    depth_outliers: float = 0.02
    """Likelihood of a known depth where a ray has no weight: the larger, the less influence false depths have."""
    tv_density: float = 1e-4
    """Total variation of the densities, in DVGO's normalisation (there: 1e-5)."""
    tv_features: float = 1e-5
    """Total variation of the features, in the same normalisation (there: 1e-6)."""
    tv_every: int = 4
    """Total variation is added every this many steps, with its weight multiplied by the same number."""


def photometric(
    predicted: Float[Tensor, "R 3"], observed: Float[Tensor, "R 3"], exposure: Float[Tensor, "R 3"] | None = None
) -> Float[Tensor, ""]:
    """Mean squared colour error over rays and channels (L_pho).

    Args:
        predicted: colours of the field.
        observed: colours of the images divided by their exposures.
        exposure: of each ray's image. Errors are those in the image, and where it is clipped the scene may be brighter.
            None: all have the same.
    """
    error = predicted - observed
    if exposure is not None:
        clipped = observed * exposure > CLIPPED
        error = exposure * torch.where(clipped, error.clamp(max=0), error)
    return (error**2).mean()


def point_color(
    mass: Float[Tensor, "R 1"],
    first: Float[Tensor, "R 3"],
    second: Float[Tensor, "R 3"],
    observed: Float[Tensor, "R 3"],
) -> Float[Tensor, ""]:
    """Each sample's own colour against its ray's, weighted by its rendering weight (L_pt_rgb; weights held fixed).

    sum_s w_s |c_s - o|^2, mean over rays, from the sums over each ray's samples of w, w c and w c^2.
    """
    error = second - 2 * observed * first + observed**2 * mass
    return error.sum() / max(1, observed.shape[0])


def background_entropy(transmittance: Float[Tensor, "R 1"]) -> Float[Tensor, ""]:
    """Entropy of the transmittance behind the last sample: a ray should be either opaque or empty (L_bg)."""
    p = transmittance.clamp(1e-6, 1 - 1e-6)
    return -(p * p.log() + (1 - p) * (1 - p).log()).mean()


def distortion(
    weights: Float[Tensor, "R S"], positions: Float[Tensor, "R S"], intervals: Float[Tensor, "R S"]
) -> Float[Tensor, ""]:
    """Spread of a ray's weights (L_dist): sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 delta_i, mean over rays.

    O(S) a ray by prefix sums, which needs ``positions`` sorted along the ray.

    Args:
        weights: rendering weights, 0 in empty slots.
        positions: s, a monotone map of the merged distance into [0, 1].
        intervals: delta, the length of each sample on that map.

    Source: mip-NeRF 360 eq. (15); O(N) form as in DVGO v2.
    """
    before = exclusive_cumsum(weights)
    moment_before = exclusive_cumsum(weights * positions)
    between = 2 * (weights * (positions * before - moment_before)).sum(-1)
    within = (weights**2 * intervals).sum(-1) / 3
    return (between + within).mean()


def keypoint_depth(
    weights: Float[Tensor, "R S"],
    inverse_t: Float[Tensor, "R S"],
    known_inverse_t: Float[Tensor, "R 1"],
    valid: Bool[Tensor, "R S"],
    relative_width: float = 0.06,
) -> Float[Tensor, ""]:
    """-log of the weight mass near an SfM keypoint's known inverse distance, mean over the rays that can reach it.

    A soft window exp(-1/2 ((q - q0) / (width q0))^2) in inverse distance q. Rays without a sample within three widths
    carry no information about the point and are left out.

    Args:
        weights: rendering weights of the keypoint rays.
        inverse_t: inverse distances of their samples.
        known_inverse_t: inverse distance of the SfM point; 0 marks a ray without one.
        valid: which slots hold a sample.
        relative_width: standard deviation of the window relative to the known inverse distance.
    """
    scaled = (inverse_t - known_inverse_t) / (relative_width * known_inverse_t.clamp(min=1e-12))
    window = _window(scaled, valid)
    reachable = (valid & (scaled.abs() < 3)).any(-1) & (known_inverse_t[:, 0] > 0)
    mass = (weights * window).sum(-1)
    nll = -torch.log(mass + 1e-4)
    count = reachable.sum().clamp(min=1)
    return torch.where(reachable, nll, torch.zeros_like(nll)).sum() / count


def _window(scaled: Float[Tensor, "R S"], valid: Bool[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """exp(-1/2 scaled^2), 0 in empty slots; never below 1e-26, since exponentials that underflow take far longer."""
    return torch.where(valid, torch.exp(-0.5 * scaled.square().clamp(max=120)), torch.zeros_like(scaled))


def known_depth(
    weights: Float[Tensor, "R S"],
    inverse_t: Float[Tensor, "R S"],
    known: Float[Tensor, "R 2"],
    valid: Bool[Tensor, "R S"],
    least_error: float,
    outliers: float = 0.02,
) -> Float[Tensor, ""]:
    """-log of the likelihood of measured inverse distances given the weights along their rays, mean over all rays.

    A measurement is either right, so that the weights lie within its error, exp(-1/2 ((q - q0) / error)^2), or an
    outlier, so that they may lie anywhere: -log(mass + outliers). The gradient is at most 1 / outliers, so a
    measurement that many views contradict is ignored.

    Args:
        weights: rendering weights.
        inverse_t: inverse distances of the samples.
        known: measured inverse distance, 0 if there is none, and its expected error.
        valid: which slots hold a sample.
        least_error: lower bound on all errors, from the spacing of planes.
        outliers: likelihood of an outlier.
    """
    error = torch.hypot(known[:, 1:], torch.full_like(known[:, 1:], least_error)).clamp(min=1e-12)
    scaled = (inverse_t - known[:, :1]) / error
    window = _window(scaled, valid)
    reachable = (valid & (scaled.abs() < 3)).any(-1) & (known[:, 0] > 0)
    nll = -torch.log((weights * window).sum(-1) + outliers)
    return torch.where(reachable, nll, torch.zeros_like(nll)).mean() if len(nll) else weights.sum()


def batch_losses(
    rays: RenderedRays, field: MMPIField, image: Tensor, weight: LossWeights, g: torch.Generator, step: int
) -> dict[str, Tensor]:
    """All losses of a training batch, each times its weight.

    Args:
        rays: pixel rays, then keypoint rays.
        field: rendered for these rays.
        image: [P, 3 or 4] colours of the pixels.
        weight: of each loss.
        g: draws the colours behind the pixels.
        step: of the training.
    """
    known, exposure = (rays.bundle.metadata.get(name) for name in (KEYPOINT_DEPTH, EXPOSURE))
    # Counted on the host: asking the GPU which rays are pixel rays would be a synchronisation.
    asked, size, device = len(image), len(rays.bundle) // rays.times, image.device
    starts = size * torch.arange(rays.times, device=device)[:, None]
    pixels = (starts + torch.arange(asked, device=device)).reshape(-1)
    keypoints = (starts + torch.arange(asked, size, device=device)).reshape(-1)
    image = image.repeat(rays.times, 1)
    random = torch.rand(image.shape[0], 3, generator=g, device=image.device)
    observed = over_background(image, random)
    # If MPIs train separately and cover a ray only in part, they need not explain the remaining transmittance.
    explained = rays.report.explained[pixels]
    background = torch.where(explained, random, observed)
    c, colors = rays.composite, rays.colors.of_rays(pixels)
    composite = Composite(*(x.index_select(0, pixels) for x in (c.weights, c.accumulation, c.transmittance)))
    rgb = colors.rgb + composite.transmittance * background
    total = {
        "rgb_loss": photometric(rgb, observed, None if exposure is None else exposure.index_select(0, pixels)),
        "point_color": weight.point_color * point_color(colors.mass, colors.first, colors.second, observed),
        "entropy": weight.background_entropy * background_entropy(composite.transmittance),
        "distortion": weight.distortion * _distortion(rays, pixels, composite, field.plan.content_near),
    }
    if known is not None and len(keypoints):
        total["keypoint_depth"] = weight.keypoint_depth * _keypoint_depth(rays, keypoints, known)
    if PIXEL_DEPTH in rays.bundle.metadata and weight.known_depth > 0:
        total["known_depth"] = weight.known_depth * _known_depth(rays, pixels, composite, field, weight.depth_outliers)
    if rays.lookup is not None and step % weight.tv_every == 0 and field.density.requires_grad:
        total["tv"] = field.total_variation(rays.lookup, weight.tv_density, weight.tv_features) * (
            weight.tv_every / max(1, image.shape[0])
        )
    return total


def _distortion(rays: RenderedRays, pixels: Tensor, composite: Composite, scale: float) -> Tensor:
    inverse_t = metadata_of(rays.samples)["inverse_t"][..., 0].index_select(0, pixels)
    positions = 1 / (1 + inverse_t * scale)
    intervals = (1 / rays.report.live[pixels].clamp(min=1))[:, None].to(positions.dtype)
    return distortion(composite.weights, positions, intervals.expand_as(positions))


def _known_depth(rays: RenderedRays, pixels: Tensor, composite: Composite, field: MMPIField, outliers: float) -> Tensor:
    meta = metadata_of(rays.samples)
    inverse_t, valid = (meta[name][..., 0].index_select(0, pixels) for name in ("inverse_t", "valid"))
    known = rays.bundle.metadata[PIXEL_DEPTH].index_select(0, pixels)
    # The plane spacing in inverse distance; a surface between two planes is represented by both.
    spacings = [1 / (m.near * max(1, m.planes - 1)) for m in field.plan.mpis]
    least = PLANE_ERROR * sum(spacings) / max(1, len(spacings))
    return known_depth(composite.weights, inverse_t, known, valid, least, outliers)


def _keypoint_depth(rays: RenderedRays, chosen: Tensor, known: Tensor) -> Tensor:
    meta = metadata_of(rays.samples)
    return keypoint_depth(
        rays.composite.weights.index_select(0, chosen),
        meta["inverse_t"][..., 0].index_select(0, chosen),
        known[chosen],
        meta["valid"][..., 0].index_select(0, chosen),
    )


def over_background(image: Tensor, background: Tensor) -> Tensor:
    """RGBA over a background; RGB unchanged."""
    if image.shape[-1] == 4:
        return image[..., :3] * image[..., 3:] + background * (1 - image[..., 3:])
    return image
