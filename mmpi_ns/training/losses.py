"""The losses: each a small pure function, and their weighted sum for a training batch (paper sec. III-E, and depth).

Weights and normalisations: docs/how_it_works.md. Total variation is computed on the tables (``ops/variation``).
"""

from __future__ import annotations

from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.data.rays import TrainingRays
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.depth_sums import DepthSums, depth_sums
from mmpi_ns.rendering.rendered import RenderedRays
from mmpi_ns.settings import LossWeights

CLIPPED = 0.98
"""Colour of an image above which a channel may be clipped."""
PLANE_ERROR = 0.6
"""Minimum error of a depth prior, in spacings of the densest planes."""
TV_EVERY = 4
"""Total variation is added every this many steps, with its weight multiplied by the same number."""
DEPTH_OUTLIERS = 0.02
"""Likelihood of a depth prior where a ray has no weight: the larger, the less influence outliers have."""
KEYPOINT_WIDTH, KEYPOINT_OUTLIERS = 0.06, 1e-4
"""Standard deviation of the window round an SfM keypoint, relative to its inverse distance, and likelihood of a false
one. Its mean is over the keypoint rays that can reach their point."""


def photometric(
    predicted: Float[Tensor, "R 3"], observed: Float[Tensor, "R 3"], exposure: Float[Tensor, "R 3"] | None = None
) -> Float[Tensor, ""]:
    """Mean squared colour error over rays and channels (L_pho).

    Args:
        predicted: colours of the field.
        observed: colours of the images divided by their exposures.
        exposure: of each ray's image. Errors are those in the image; where it is clipped, a brighter scene costs
            nothing. None: all are equal.
    """
    if exposure is None:
        return torch.nn.functional.mse_loss(predicted, observed)
    error, clipped = predicted - observed, observed * exposure > CLIPPED
    return ((exposure * torch.where(clipped, error.clamp(max=0), error)) ** 2).mean()


def point_color(
    mass: Float[Tensor, "R 1"],
    first: Float[Tensor, "R 3"],
    second: Float[Tensor, "R 3"],
    observed: Float[Tensor, "R 3"],
) -> Float[Tensor, ""]:
    """Colour of each sample against its ray's, weighted by its rendering weight (L_pt_rgb; weights held fixed).

    sum_s w_s |c_s - o|^2, mean over rays, from the sums over each ray's samples of w, w c and w c^2.
    """
    error = second - 2 * observed * first + observed**2 * mass
    return error.sum() / max(1, observed.shape[0])


def background_entropy(transmittance: Float[Tensor, "R 1"]) -> Float[Tensor, ""]:
    """Entropy of the transmittance behind the last sample: a ray should be either opaque or empty (L_bg)."""
    p = transmittance.clamp(1e-6, 1 - 1e-6)
    return torch.special.entr(torch.cat([p, 1 - p], -1)).sum(-1).mean()


def depth_priors(
    mass: Float[Tensor, "R"], reached: Bool[Tensor, "R"], outliers: float, count: Int[Tensor, ""] | int
) -> Float[Tensor, ""]:
    """-log of the likelihood of inverse distances given the weights along their rays, mean over ``count`` rays.

    A distance is either right, so that the weights lie within its error, exp(-1/2 ((q - q0) / error)^2), or an outlier,
    so that they may lie anywhere: -log(mass + outliers). The gradient is at most 1 / outliers, so a distance that many
    views contradict is ignored. Rays without a sample near their distance add nothing.

    Args:
        mass: weights near the inverse distance (``depth_sums``, the window its error).
        reached: rays with a sample near it.
        outliers: likelihood of an outlier.
        count: rays that the mean is over.
    """
    return (mass + outliers).masked_fill(~reached, 1).log().sum() / -count


def batch_losses(
    rays: RenderedRays,
    field: MMPIField,
    image: Tensor,
    weight: LossWeights,
    g: torch.Generator,
    step: int,
    decay: float | Float[Tensor, ""] = 1.0,
) -> tuple[dict[str, Tensor], Float[Tensor, "R"]]:
    """All losses of a training batch, each times its weight; and the squared colour error of each ray.

    Args:
        rays: rendered by ``field`` from ``TrainingRays``: pixel rays, then keypoint rays.
        image: [P, 3 or 4] colours of the pixels.
        g: draws the colours behind the pixels.
        decay: of the weight of depth priors at this step.

    Returns:
        Losses by name, and errors without gradients, 0 for keypoint rays.
    """
    bundle = rays.bundle
    assert isinstance(bundle, TrainingRays)
    # Counted on the host: asking the GPU which rays are pixel rays would be a synchronisation.
    asked, size = len(image), len(bundle) // rays.times

    def chosen(values: Tensor, first: int, end: int) -> Tensor:
        return values.view(rays.times, size, *values.shape[1:])[:, first:end].flatten(0, 1)

    of_pixels, of_keypoints = partial(chosen, first=0, end=asked), partial(chosen, first=asked, end=size)
    image = image.expand(rays.times, *image.shape).flatten(0, 1)
    random = torch.rand(image.shape[0], 3, generator=g, device=image.device)
    observed = over_background(image, random)
    # If MPIs train separately and cover a ray only in part, the remaining transmittance is not penalised.
    background = torch.where(of_pixels(rays.samples.fully_covered), random, observed)
    per_ray = (rays.rgb, rays.sums.mass, rays.sums.first, rays.sums.second, rays.composite.transmittance)
    colors, mass, first, second, transmittance = map(of_pixels, per_ray)
    rgb = colors + transmittance * background
    sums = _depth_sums(rays, bundle, field)
    exposure = None if bundle.exposures is None else of_pixels(bundle.exposures)
    total = {
        "rgb_loss": photometric(rgb, observed, exposure),
        "point_color": weight.point_color * point_color(mass, first, second, observed),
        "entropy": weight.background_entropy * background_entropy(transmittance),
        "distortion": weight.distortion * of_pixels(sums.spread).mean(),
    }
    if asked < size:
        reached = of_keypoints(sums.reached)
        total["keypoint_depth"] = weight.keypoint_depth * depth_priors(
            of_keypoints(sums.mass), reached, KEYPOINT_OUTLIERS, reached.sum().clamp(min=1)
        )
    if bundle.disparities is not None and weight.depth_priors > 0:
        total["depth_priors"] = (weight.depth_priors * decay) * depth_priors(
            of_pixels(sums.mass), of_pixels(sums.reached), DEPTH_OUTLIERS, max(1, len(image))
        )
    if rays.lookup is not None and step % TV_EVERY == 0 and field.density.requires_grad:
        variation = field.total_variation(rays.lookup, weight.tv_density, weight.tv_features, weight.tv_chroma)
        total["tv"] = TV_EVERY / max(1, len(image)) * variation
    errors = ((rgb - observed).detach() ** 2).sum(-1)
    return total, pad(errors.view(rays.times, asked), (0, size - asked)).flatten()


def _depth_sums(rays: RenderedRays, bundle: TrainingRays, field: MMPIField) -> DepthSums:
    """Depth sums of all rays; the target is a keypoint or the depth prior of a pixel."""
    samples, targets = rays.samples, bundle.disparities
    targets = bundle.origins.new_zeros(len(bundle), 2) if targets is None else targets
    # The spacing of planes in inverse distance: a surface between two is represented by both. Those of the densest MPI
    # count: one with few planes may stand at a camera, where they suffice.
    least = max(1e-12, PLANE_ERROR * min((m.disparity_step for m in field.plan.mpis), default=0.0))
    targets = torch.stack([targets[:, 0], (targets[:, 1] ** 2 + least**2).sqrt()], -1)
    if (keypoints := bundle.keypoint_disparities) is not None:
        windows = torch.cat([keypoints, KEYPOINT_WIDTH * keypoints], -1)
        targets = torch.where(keypoints > 0, windows, targets)
    weights, intervals = rays.composite.weights, samples.num_intersected.clamp(min=1).to(rays.rgb).reciprocal()
    return depth_sums(weights, samples.inverse_t, samples.starts, intervals, targets, field.plan.content_near)


def over_background(image: Tensor, background: Tensor | float) -> Tensor:
    """RGBA over a background; RGB unchanged."""
    if image.shape[-1] == 4:
        return image[..., :3] * image[..., 3:] + background * (1 - image[..., 3:])
    return image
