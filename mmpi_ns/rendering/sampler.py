"""Sample and merge: each ray is sampled in every MPI, the samples are merged by distance (paper sec. III-B).

The march has no gradients. The field later differentiates through the samples that were kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.ray_samplers import Sampler
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.march import MarchOptions, MergedSamples, Rays, march
from mmpi_ns.scene.plan import ScenePlan

FAIR_SHARE = 0.1
"""While surfaces are forming, samples with more than this fraction of an equal weight are kept."""


@dataclass
class SamplingConfig:
    """Samples of a ray: ``--pipeline.model.sampling.*``."""

    threshold: float = 3e-3
    """Samples of less weight get no gradient (at most a tenth of an equal share while the resolution grows)."""
    cube_alpha: float = 1e-3
    """Initial alpha of a cube sample: 1e-2 for a small room to 1e-4."""

    def options(self, plan: ScenePlan, forming: bool, blends: bool) -> MarchOptions:
        """Which samples are kept in training (``ops.march.prune``).

        While surfaces are forming, samples of little weight must learn too, and the cube starts nearly empty.
        """
        cube = 0.1 * self.cube_alpha if forming and plan.cube is not None else float("inf")
        return MarchOptions(min(self.threshold, cube), FAIR_SHARE if forming else float("inf"), blends)


class MMPISampler(Sampler):
    """Samples rays in all MPIs and the cube, and merges by distance.

    Its samples are ``MergedSamples``: nerfstudio's ``RaySamples`` have no place for a sample's head, plane and NDC.
    """

    def generate_ray_samples(  # type: ignore[override]
        self,
        ray_bundle: RayBundle,
        field: MMPIField,
        options: MarchOptions,
        head_mask: Bool[Tensor, "R H"] | None = None,
        choose: Float[Tensor, "R K"] | None = None,
    ) -> MergedSamples:
        """Kept samples of each ray, nearest first.

        Args:
            ray_bundle: R rays; nears and fars bound the samples.
            field: heads to sample, with their optical depths.
            options: which samples are kept, and how they are blended.
            head_mask: heads that may render each ray; None for all.
            choose: priorities; each ray is rendered by the MPI of highest priority among those it meets (and the cube).
        """
        with torch.no_grad():
            return march(field.layout, field.tables, rays_of(ray_bundle, head_mask, choose), options)


def rays_of(ray_bundle: RayBundle, head_mask: Tensor | None = None, choose: Tensor | None = None) -> Rays:
    """Rays for the march, and the heads that may render them (see ``ops.march.Rays``)."""
    nears, fars = ray_bundle.nears, ray_bundle.fars
    assert nears is not None and fars is not None
    return Rays(ray_bundle.origins, ray_bundle.directions, nears, fars, head_mask, choose)
