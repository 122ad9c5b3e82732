"""The losses: each a small pure function, and their weighted sum for a training batch (paper sec. III-E, and depth).

Weights and normalisations: docs/how_it_works.md. Total variation is computed on the tables (``ops/variation``).
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.data.rays import TrainingRays
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.depth_sums import DepthSums, depth_sums
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.ray_losses import CLIPPED, DEPTH_OUTLIERS, KEYPOINT_OUTLIERS, KEYPOINT_WIDTH, LEAST, RayLosses
from mmpi_ns.rendering.rendered import RenderedRays
from mmpi_ns.settings import LossWeights

PLANE_ERROR = 0.6
"""Minimum error of a depth prior, in spacings of the densest planes."""
TV_EVERY = 4
"""Total variation is added every this many steps, with its weight multiplied by the same number."""


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
    p = transmittance.clamp(LEAST, 1 - LEAST)
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


@operation("gpu", kernels="mmpi_ns.ops.ray_losses")
def ray_losses(
    rgb: Float[Tensor, "R 3"],
    transmittance: Float[Tensor, "R 1"],
    mass: Float[Tensor, "R 1"],
    first: Float[Tensor, "R 3"],
    second: Float[Tensor, "R 3"],
    spread: Float[Tensor, "R"],
    near: Float[Tensor, "R"],
    reached: Bool[Tensor, "R"],
    fully_covered: Bool[Tensor, "R 1"],
    exposures: Float[Tensor, "R 3"] | None,
    image: Float[Tensor, "P C"],
    random: Float[Tensor, "T*P 3"],
    times: int,
    weights: tuple[float, ...],
    decay: float | Float[Tensor, ""],
    has_depths: bool,
) -> RayLosses:
    """Losses of a batch of pixel rays, then keypoint rays, all of them ``times`` times, with gradients to ``rgb``,
    ``transmittance``, ``first``, ``second``, ``spread`` and ``near``.

    Args:
        rgb: without a background.
        transmittance: behind the last sample.
        mass, first, second: sums of weight, colour and squared colour (``RaySums``).
        spread, near, reached: of ``depth_sums``, near the distance of a keypoint or of a pixel's depth prior.
        fully_covered: rays that must reproduce their whole pixel.
        exposures: of the rays' images; None if all are equal.
        image: RGB or RGBA of the pixels.
        random: colours behind the pixels.
        weights: of the losses but the first, in the order of ``RayLosses``.
        decay: of the weight of depth priors.
        has_depths: pixels may have depth priors.
    """
    asked, size = len(image), len(rgb) // times

    def chosen(values: Tensor, first: int = 0, end: int = asked) -> Tensor:
        return values.view(times, size, *values.shape[1:])[:, first:end].flatten(0, 1)

    observed = over_background(image.expand(times, *image.shape).flatten(0, 1), random)
    # If MPIs train separately and cover a ray only in part, the remaining transmittance is not penalised.
    background = torch.where(chosen(fully_covered), random, observed)
    colors, mass, first, second, transmittance = map(chosen, (rgb, mass, first, second, transmittance))
    colors = colors + transmittance * background
    keypoint_depth = depth = None
    of_color, of_entropy, of_distortion, of_keypoints, of_depths = weights
    rgb_loss = photometric(colors, observed, None if exposures is None else chosen(exposures))
    color_loss = of_color * point_color(mass, first, second, observed)
    entropy = of_entropy * background_entropy(transmittance)
    distortion = of_distortion * chosen(spread).mean()
    if asked < size:
        at_points = chosen(reached, asked, size)
        mean_over = at_points.sum().clamp(min=1)
        keypoint_depth = of_keypoints * depth_priors(chosen(near, asked, size), at_points, KEYPOINT_OUTLIERS, mean_over)
    if has_depths:
        of_depths = of_depths * decay
        depth = of_depths * depth_priors(chosen(near), chosen(reached), DEPTH_OUTLIERS, max(1, len(observed)))
    errors = pad(((colors - observed).detach() ** 2).sum(-1).view(times, asked), (0, size - asked)).flatten()
    return RayLosses(rgb_loss, color_loss, entropy, distortion, keypoint_depth, depth, errors)


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
    bundle, sums, composite = rays.bundle, rays.sums, rays.composite
    assert isinstance(bundle, TrainingRays)
    # Counted on the host: asking the GPU which rays are pixel rays would be a synchronisation.
    pixels, count = rays.times * len(image), max(1, rays.times * len(image))
    random = torch.rand(pixels, 3, generator=g, device=image.device)
    depths = _depth_sums(rays, bundle, field)
    names = ("point_color", "background_entropy", "distortion", "keypoint_depth", "depth_priors")
    weights = tuple(float(getattr(weight, name)) for name in names)
    has_depths = bundle.disparities is not None and weight.depth_priors > 0
    *losses, errors = ray_losses(
        rays.rgb, composite.transmittance, sums.mass, sums.first, sums.second, *depths, rays.samples.fully_covered,
        bundle.exposures, image, random, rays.times, weights, decay, has_depths,
    )  # fmt: skip
    total = {name: x for name, x in zip(RayLosses._fields, losses, strict=False) if x is not None}
    if rays.lookup is not None and step % TV_EVERY == 0 and field.density.requires_grad:
        variation = field.total_variation(rays.lookup, weight.tv_density, weight.tv_features, weight.tv_chroma)
        total["tv"] = TV_EVERY / count * variation
    return total, errors


def _depth_sums(rays: RenderedRays, bundle: TrainingRays, field: MMPIField) -> DepthSums:
    """Depth sums of all rays; the target is a keypoint or the depth prior of a pixel."""
    samples = rays.samples
    # The spacing of planes in inverse distance: a surface between two is represented by both. Those of the densest MPI
    # count: one with few planes may stand at a camera, where they suffice.
    least = max(1e-12, PLANE_ERROR * min((m.disparity_step for m in field.plan.mpis), default=0.0))
    known = bundle.disparities, bundle.keypoint_disparities
    targets, intervals = depth_targets(*known, samples.num_intersected, least)
    weights = rays.composite.weights
    return depth_sums(weights, samples.inverse_t, samples.starts, intervals, targets, field.plan.content_near)


@operation("gpu", kernels="mmpi_ns.ops.ray_losses")
def depth_targets(
    disparities: Float[Tensor, "R 2"] | None,
    keypoints: Float[Tensor, "R 1"] | None,
    counts: Int[Tensor, "R"],
    least: float,
) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R"]]:
    """Inverse distance that each ray should have, with the width of a window around it; and intervals of its samples.

    Args:
        disparities: of pixels, and their errors, 0 where there is none.
        keypoints: of keypoint rays, 0 on other rays.
        counts: planes that each ray intersects.
        least: minimum error of a pixel's inverse distance.
    """
    targets = torch.zeros(len(counts), 2, device=counts.device) if disparities is None else disparities
    targets = torch.stack([targets[:, 0], (targets[:, 1] ** 2 + least**2).sqrt()], -1)
    if keypoints is not None:
        targets = torch.where(keypoints > 0, torch.cat([keypoints, KEYPOINT_WIDTH * keypoints], -1), targets)
    return targets, counts.clamp(min=1).to(targets).reciprocal()


def over_background(image: Tensor, background: Tensor | float) -> Tensor:
    """RGBA over a background; RGB unchanged."""
    if image.shape[-1] == 4:
        return image[..., :3] * image[..., 3:] + background * (1 - image[..., 3:])
    return image
