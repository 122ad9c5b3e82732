"""Sample and merge: each ray is sampled in every MPI, the samples are merged by distance (paper sec. III-B).

The march has no gradients. The field later differentiates through the samples that were kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.rays import Frustums, RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import Sampler
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.march import MarchOptions, MergedSamples, Rays, march
from mmpi_ns.scene.plan import ScenePlan

DIRECTION_AT_INFINITY = 1e-10
"""Inverse distances below this become a distance of 1e10 in nerfstudio's starts and ends."""
FAIR_SHARE = 0.1
"""While surfaces are forming, samples with more than this fraction of an equal weight are kept."""


@dataclass
class SamplingConfig:
    """Samples of a ray: ``--pipeline.model.sampling.*``."""

    threshold: float = 3e-3
    """Samples of less weight get no gradient (at most a tenth of an equal share while the resolution grows)."""
    samples_per_voxel: float = 1.0
    """Samples per voxel side along a ray through the cube."""
    cube_alpha: float = 1e-3
    """Initial alpha of a cube sample: 1e-2 for a small room to 1e-4."""

    def bounds(self, plan: ScenePlan, forming: bool) -> dict[str, float]:
        """Minimum weights of samples kept in training (``ops.march.prune``).

        While surfaces are forming, samples of little weight must learn too, and the cube starts nearly empty.
        """
        cube = 0.1 * self.cube_alpha if forming and plan.cube is not None else float("inf")
        return {"threshold": min(self.threshold, cube), "fair_share": FAIR_SHARE if forming else float("inf")}


class MMPISampler(Sampler):
    """Samples rays in all MPIs and the cube, and merges by distance."""

    def generate_ray_samples(  # type: ignore[override]
        self,
        ray_bundle: RayBundle | None = None,
        *,
        field: MMPIField,
        threshold: float,
        fair_share: float = float("inf"),
        head_mask: Bool[Tensor, "R H"] | None = None,
        choose: Float[Tensor, "R K"] | None = None,
        blends: bool = False,
        **_: Any,
    ) -> tuple[RaySamples, MergedSamples]:
        """Kept samples of each ray, nearest first.

        Args:
            ray_bundle: R rays; nears and fars bound the samples.
            field: heads to sample, with their optical depths.
            threshold: with fair_share and blends, see ``ops.march.MarchOptions``.
            head_mask: heads that may render each ray; None for all.
            choose: priorities; each ray is rendered by the MPI of highest priority among those it meets (and the cube).

        Returns:
            RaySamples [R, S] whose metadata holds ``heads``, ``planes``, ``ndc``, ``inverse_t``, ``valid``,
            ``skipped_before`` and ``tau``, the (blended) optical depth (each [R, S, .]), and the march's own report.
        """
        assert ray_bundle is not None
        options = MarchOptions(threshold, fair_share, blends)
        with torch.no_grad():
            merged = march(field.layout, field.tables, rays_of(ray_bundle, head_mask, choose), options)
        shape, names = merged.valid.shape, ("heads", "planes", "inverse_t", "valid", "skipped_before", "tau")
        # A sample is a point on a plane, so it starts and ends at the same distance.
        t = 1 / merged.inverse_t[..., None].clamp(min=DIRECTION_AT_INFINITY)
        frustums = _Frustums(
            origins=ray_bundle.origins[:, None].expand(*shape, 3),
            directions=ray_bundle.directions[:, None].expand(*shape, 3),
            starts=t,
            ends=t,
            pixel_area=ray_bundle.pixel_area[:, None].expand(*shape, 1),
        )
        metadata = {"ndc": merged.ndc, **{name: getattr(merged, name)[..., None] for name in names}}
        return _Samples(frustums=frustums, camera_indices=None, metadata=metadata), merged


def rays_of(ray_bundle: RayBundle, head_mask: Tensor | None = None, choose: Tensor | None = None) -> Rays:
    """Rays for the march, and the heads that may render them (see ``MMPISampler``)."""
    nears, fars = ray_bundle.nears, ray_bundle.fars
    assert nears is not None and fars is not None
    return Rays(ray_bundle.origins, ray_bundle.directions, nears, fars, head_mask, choose)


class _Frustums(Frustums):
    """All parts have the same shape already: nerfstudio's broadcasting takes 2 of 75 ms of a training step."""

    def __post_init__(self) -> None:
        self._shape = self.starts.shape[:-1]


class _Samples(RaySamples):
    """Likewise."""

    def __post_init__(self) -> None:
        self._shape = self.frustums.shape
