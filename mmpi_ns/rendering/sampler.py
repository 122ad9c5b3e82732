"""Sample and merge: each ray is sampled in every MPI, the samples are merged by distance (paper sec. III-B).

The march has no gradients. The field later differentiates through the samples that were kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import Frustums, RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import Sampler
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.hits import plane_hits
from mmpi_ns.ops.march import Crossings, MarchOptions, MergedSamples, march
from mmpi_ns.scene.geometry import PlaneHits, cube_hits, sample_disparity

DIRECTION_AT_INFINITY = 1e-10
"""Inverse distances below this become a distance of 1e10 in nerfstudio's starts and ends."""


@dataclass
class SamplingConfig:
    """Samples of a ray: ``--pipeline.model.sampling.*``."""

    threshold: float = 3e-3
    """Samples of less weight get no gradient (at most a tenth of an equal share while the resolution grows)."""
    samples_per_voxel: float = 1.0
    """Samples per voxel side along a ray through the cube."""
    cube_alpha: float = 1e-3
    """Initial alpha of a cube sample: 1e-2 for a small room to 1e-4."""


@dataclass(frozen=True)
class MergeReport:
    """Output of the sampler for each ray besides its samples."""

    live: Int[Tensor, "R"]
    """Samples before dropping."""
    skipped_total: Float[Tensor, "R 1"]
    """Optical depth of the dropped samples."""
    dropped_mass: Float[Tensor, "R 1"]
    """Rendering weight of the dropped samples: the error bound of dropping."""
    explained: Bool[Tensor, "R 1"]
    """Whether the given heads must explain the whole ray: they cover it from before the first content out to infinity,
    or there are no other heads."""
    head_counts: tuple[int, ...] | None
    """Samples of each head, if the march counted them."""


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
    ) -> tuple[RaySamples, MergeReport]:
        """Kept samples of each ray, nearest first.

        Args:
            ray_bundle: R rays; nears and fars bound the samples.
            field: heads to sample, with their optical depths.
            threshold: see ``ops.march.MarchOptions``.
            fair_share: likewise.
            head_mask: heads that may render each ray; None for all.
            choose: priorities; each ray is rendered by the MPI of highest priority among those it meets (and the cube).
            blends: samples are blended by reliability.

        Returns:
            RaySamples [R, S] whose metadata holds ``heads``, ``planes``, ``ndc``, ``inverse_t``, ``valid``,
            ``skipped_before`` and ``tau``, the (blended) optical depth (each [R, S, .]), and what was left out.
        """
        assert ray_bundle is not None
        with torch.no_grad():
            at = crossings(ray_bundle, field, head_mask, choose)
            explained = (at.counts > 0).any(-1, keepdim=True)
            if head_mask is not None or choose is not None:
                explained &= _sees_all(at.hits, at.counts[:, : len(field.plan.mpis)], field)
            options = MarchOptions(threshold, fair_share, blends)
            merged = march(field.layout, field.tables, at, options)
        left = merged.skipped_total, merged.dropped_mass
        report = MergeReport(at.counts.sum(-1), *left, explained, merged.head_counts)
        return _ray_samples(ray_bundle, merged), report


def crossings(
    ray_bundle: RayBundle, field: MMPIField, head_mask: Tensor | None = None, choose: Tensor | None = None
) -> Crossings:
    """The live samples of rays in the heads that may render them (see ``MMPISampler``)."""
    origins, directions, nears, fars = ray_bundle.origins, ray_bundle.directions, ray_bundle.nears, ray_bundle.fars
    assert nears is not None and fars is not None
    hits = plane_hits(origins, directions, nears, fars, field.layout)
    first, counts = hits.m_first, hits.count
    if choose is not None:
        best = torch.where(counts > 0, choose, torch.full_like(choose, -1.0)).argmax(-1, keepdim=True)
        counts = torch.zeros_like(counts).scatter(1, best, counts.gather(1, best))
    if field.cube is not None:
        start, count = cube_hits(origins, directions, nears, fars, field.cube)
        first, counts = torch.cat([first, start[:, None]], -1), torch.cat([counts, count[:, None]], -1)
    if head_mask is not None:
        counts = torch.where(head_mask, counts, torch.zeros_like(counts))
    return Crossings(origins, directions, hits, first, counts)


class _Frustums(Frustums):
    """All parts have the same shape already: nerfstudio's broadcasting takes 2 of 75 ms of a training step."""

    def __post_init__(self) -> None:
        self._shape = self.starts.shape[:-1]


class _Samples(RaySamples):
    """Likewise."""

    def __post_init__(self) -> None:
        self._shape = self.frustums.shape


def _sees_all(hits: PlaneHits, counts: Int[Tensor, "R K"], field: MMPIField) -> Bool[Tensor, "R 1"]:
    """Whether some head covers the ray out to infinity, and the first head is entered before the first content."""
    live = counts > 0
    # One plane before the first live one bounds the entry: behind the camera means that the ray starts inside.
    m_before = torch.minimum(hits.m_first + 1, field.frames.num_planes - 1)
    w = sample_disparity(m_before, field.frames.disparity_steps, field.frames.last_disparities)
    oz, dz = hits.local_origins[..., 2], hits.local_directions[..., 2]
    starts_inside = w * oz >= 1
    entry = torch.where(starts_inside, torch.inf, w * dz / torch.where(starts_inside, 1, 1 - w * oz))
    entered = (live & (entry * field.plan.content_near >= 1)).any(-1, keepdim=True)
    to_infinity = (live & (hits.m_first - counts < 0) & (field.frames.last_disparities == 0)).any(-1, keepdim=True)
    return entered & to_infinity


def _ray_samples(ray_bundle: RayBundle, merged: MergedSamples) -> RaySamples:
    """nerfstudio's RaySamples; a sample is a point on a plane, so it starts and ends at the same distance."""
    shape = merged.valid.shape
    t = 1 / merged.inverse_t[..., None].clamp(min=DIRECTION_AT_INFINITY)
    frustums = _Frustums(
        origins=ray_bundle.origins[:, None].expand(*shape, 3),
        directions=ray_bundle.directions[:, None].expand(*shape, 3),
        starts=t,
        ends=t,
        pixel_area=ray_bundle.pixel_area[:, None].expand(*shape, 1),
    )
    names = ("heads", "planes", "inverse_t", "valid", "skipped_before", "tau")
    metadata = {"ndc": merged.ndc, **{name: getattr(merged, name)[..., None] for name in names}}
    return _Samples(frustums=frustums, camera_indices=None, metadata=metadata)
