"""The losses of a rendered training batch, each times its weight (paper sec. III-E, and SfM depth)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from nerfstudio.cameras.rays import RayBundle, RaySamples
from torch import Tensor

from mmpi_ns.capture.datamanager import KEYPOINT_DEPTH
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import Lookup, metadata_of
from mmpi_ns.field.shading import RayColors
from mmpi_ns.ops.compositing import Composite
from mmpi_ns.rendering.sampler import MergeReport
from mmpi_ns.training import losses


@dataclass
class LossWeights:
    """Weights of the losses beside the photometric one."""

    point_color: float = 0.01
    """Colour of each sample against its ray's."""
    background_entropy: float = 0.001
    """Entropy of what passes a ray."""
    distortion: float = 0.01
    """Spread of a ray's mass over distance."""
    keypoint_depth: float = 0.02
    """-log of the mass near an SfM keypoint (scenes with tracks)."""
    tv_density: float = 1e-4
    """Total variation of the densities, in DVGO's normalisation (there: 1e-5)."""
    tv_features: float = 1e-5
    """Total variation of the features, likewise (there: 1e-6)."""
    tv_every: int = 4
    """Total variation is added every so many steps, at so many times its weight."""
    exposure: float = 1e-3
    """Squared distance of gains and biases from 1 and 0 (where exposure is on)."""


@dataclass(frozen=True)
class TrainingRays:
    """A rendered training batch: pixel rays, then keypoint rays (both repeated for every MPI they went to)."""

    bundle: RayBundle
    samples: RaySamples
    composite: Composite
    colors: RayColors
    report: MergeReport
    lookup: Lookup

    def losses(
        self, field: MMPIField, image: Tensor, weight: LossWeights, g: torch.Generator, step: int
    ) -> dict[str, Tensor]:
        """All losses of the batch, each times its weight."""
        known = self.bundle.metadata.get(KEYPOINT_DEPTH)
        num_pixels = image.shape[0]
        is_pixel = is_pixel_ray(self.bundle)
        pixels = is_pixel.nonzero()[:, 0]  # once: every use of a mask would wait for the device
        copies = len(pixels) // num_pixels
        image = image.repeat(copies, 1)
        random = torch.rand(image.shape[0], 3, generator=g, device=image.device)
        observed = over_background(image, random)
        # Where MPIs that train apart see a ray only in part, what they let through is not theirs to explain.
        explained = self.report.explained[pixels]
        background = random if image.shape[-1] == 4 else torch.where(explained, random, observed)
        composite, colors = self._pixel_composite(pixels), self.colors.of_rays(pixels)
        rgb = colors.rgb + composite.transmittance * background
        total = {
            "rgb_loss": losses.photometric(rgb, observed),
            "point_color": weight.point_color * losses.point_color(colors.mass, colors.first, colors.second, observed),
            "entropy": weight.background_entropy * losses.background_entropy(composite.transmittance),
            "distortion": weight.distortion * self._distortion(pixels, composite, field.plan.content_near),
        }
        if known is not None and len(pixels) < len(is_pixel):
            total["keypoint_depth"] = weight.keypoint_depth * self._keypoint_depth((~is_pixel).nonzero()[:, 0], known)
        if step % weight.tv_every == 0 and field.density.requires_grad:
            total["tv"] = field.total_variation(self.lookup, weight.tv_density, weight.tv_features) * (
                weight.tv_every / max(1, image.shape[0])
            )
        return total

    def _pixel_composite(self, pixels: Tensor) -> Composite:
        c = self.composite
        return Composite(*(x.index_select(0, pixels) for x in (c.weights, c.accumulation, c.transmittance)))

    def _distortion(self, pixels: Tensor, composite: Composite, scale: float) -> Tensor:
        inverse_t = metadata_of(self.samples)["inverse_t"][..., 0].index_select(0, pixels)
        positions = 1 / (1 + inverse_t * scale)
        intervals = (1 / self.report.live[pixels].clamp(min=1))[:, None].to(positions.dtype)
        return losses.distortion(composite.weights, positions, intervals.expand_as(positions))

    def _keypoint_depth(self, chosen: Tensor, known: Tensor) -> Tensor:
        meta = metadata_of(self.samples)
        return losses.keypoint_depth(
            self.composite.weights.index_select(0, chosen),
            meta["inverse_t"][..., 0].index_select(0, chosen),
            known[chosen],
            meta["valid"][..., 0].index_select(0, chosen),
        )


def is_pixel_ray(bundle: RayBundle) -> Bool[Tensor, "R"]:
    """Rays through pixels, as opposed to rays through SfM keypoints, which have a known depth but no pixel."""
    known = bundle.metadata.get(KEYPOINT_DEPTH)
    if known is None:
        return torch.ones(len(bundle), dtype=torch.bool, device=bundle.origins.device)
    return known[:, 0] == 0


def over_background(image: Tensor, background: Tensor) -> Tensor:
    """RGBA over a background; RGB as it is."""
    if image.shape[-1] == 4:
        return image[..., :3] * image[..., 3:] + background * (1 - image[..., 3:])
    return image
