"""Sample and merge: each ray is sampled in every MPI, the samples are merged by distance (paper sec. III-B).

Everything here is free of gradients. The field later differentiates through the samples that the sampler kept.
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
from mmpi_ns.field.samples import LocalRays
from mmpi_ns.ops import native
from mmpi_ns.ops.compositing import BlendForm
from mmpi_ns.ops.march import Kept, march
from mmpi_ns.ops.merge import Merged, keep_survivors, merge
from mmpi_ns.scene.geometry import PlaneHits, cube_hits, inverse_distance, sample_disparity

DIRECTION_AT_INFINITY = 1e-10
"""Inverse distances below this are written as a distance of 1e10 into nerfstudio's starts and ends."""
BLEND_BLOCK = 16
"""Samples a ray between two checks whether it is opaque already."""
OPAQUE_DEPTH = 9.2
"""exp(-9.2) = 1e-4 of the light: far below what a survivor must weigh."""


@dataclass(frozen=True)
class MergeReport:
    """What the sampler can say about each ray beyond its samples."""

    live: Int[Tensor, "R"]
    """Samples before dropping."""
    skipped_total: Float[Tensor, "R 1"]
    """Optical depth of the dropped samples."""
    dropped_mass: Float[Tensor, "R 1"]
    """Rendering weight of the dropped samples: the error bound of dropping."""
    explained: Bool[Tensor, "R 1"]
    """What the ray shows is the asked heads' to account for: they see it from before the first content out to infinity,
    or there are no other heads to see it."""


@dataclass(frozen=True)
class _HeadSamples:
    """Live samples of one head, ray by ray, near to far."""

    rays: Int[Tensor, "N"]
    planes: Int[Tensor, "N"]
    ndc: Float[Tensor, "N 3"]
    inverse_t: Float[Tensor, "N"]
    tau: Float[Tensor, "N"]


class MMPISampler(Sampler):
    """Samples rays in all MPIs and the cube, and merges by distance."""

    @torch.no_grad()
    def generate_ray_samples(  # type: ignore[override]
        self,
        ray_bundle: RayBundle | None = None,
        *,
        field: MMPIField,
        threshold: float,
        fair_share: float = float("inf"),
        head_mask: Bool[Tensor, "R H"] | None = None,
        choose: Float[Tensor, "R K"] | None = None,
        blend_form: BlendForm | None = None,
        shares: Float[Tensor, "N 1"] | None = None,
        **_: Any,
    ) -> tuple[RaySamples, MergeReport]:
        """Live samples of each ray that matter, nearest first.

        Args:
            ray_bundle: R rays; nears and fars bound the samples.
            field: heads to sample, with their optical depths.
            threshold: see ``keep_survivors``.
            fair_share: likewise.
            head_mask: heads that may answer each ray; None for all.
            choose: priorities; each ray is answered by the MPI of highest priority among those it meets (and the cube).
            blend_form: blend by reliability; None where reliability takes no part.
            shares: baked ones (``baking.bake_shares``) to blend by instead.

        Returns:
            RaySamples [R, S] whose metadata holds ``heads``, ``planes``, ``ndc``, ``inverse_t``, ``valid``,
            ``skipped_before`` and ``tau``, the (blended) optical depth (each [R, S, .]), and what was left out.
        """
        assert ray_bundle is not None and ray_bundle.nears is not None and ray_bundle.fars is not None
        origins, directions = ray_bundle.origins, ray_bundle.directions
        hits = field.plane_hits(origins, directions, ray_bundle.nears, ray_bundle.fars)
        counts, cube_first = self._counts(ray_bundle, field, hits, head_mask, choose)
        explained = (counts > 0).any(-1, keepdim=True)
        if head_mask is not None or choose is not None:
            explained &= _sees_all(hits, counts[:, : len(field.plan.mpis)], field)
        lib = native.library(origins, field.density)
        first = hits.m_first if cube_first is None else torch.cat([hits.m_first, cube_first[:, None]], -1)
        given = (origins, directions, hits, first, counts, threshold, fair_share, blend_form)
        if lib is not None:
            kept = march(lib, field.march_scene(shares), *given, baked=shares is not None)
        elif native.takes_triton(origins, field.density):
            from mmpi_ns.ops import triton_march

            kept = triton_march.march(*field.triton_scene(shares), *given, baked=shares is not None)
        else:
            kept = march_reference(ray_bundle, field, hits, cube_first, *given[4:], shares)
        report = MergeReport(counts.sum(-1), kept.skipped_total, kept.dropped_mass, explained)
        return _ray_samples(ray_bundle, kept), report

    @staticmethod
    def _counts(
        ray_bundle: RayBundle, field: MMPIField, hits: PlaneHits, head_mask: Tensor | None, choose: Tensor | None
    ) -> tuple[Int[Tensor, "R H"], Int[Tensor, "R"] | None]:
        counts, first = hits.count, None
        if choose is not None:
            best = torch.where(counts > 0, choose, torch.full_like(choose, -1.0)).argmax(-1, keepdim=True)
            counts = torch.zeros_like(counts).scatter(1, best, counts.gather(1, best))
        if field.cube is not None:
            assert ray_bundle.nears is not None and ray_bundle.fars is not None
            first, count = cube_hits(
                ray_bundle.origins, ray_bundle.directions, ray_bundle.nears, ray_bundle.fars, field.cube
            )
            counts = torch.cat([counts, count[:, None]], -1)
        if head_mask is not None:
            counts = torch.where(head_mask, counts, torch.zeros_like(counts))
        return counts, first


def march_reference(
    ray_bundle: RayBundle,
    field: MMPIField,
    hits: PlaneHits,
    cube_first: Int[Tensor, "R"] | None,
    counts: Int[Tensor, "R H"],
    threshold: float,
    fair_share: float,
    blend_form: BlendForm | None,
    shares: Float[Tensor, "N 1"] | None = None,
) -> Kept:
    """``ops.march.march`` in plain torch: looks up and sorts all live samples, then drops."""
    samples = [_sample_mpi(k, counts[:, k], hits, field) for k in range(len(field.plan.mpis))]
    if cube_first is not None:
        samples.append(_sample_cube(cube_first, counts[:, -1], ray_bundle, field))
    merged, flat, heads = _merge(samples, counts)
    tau = flat.tau
    if blend_form is not None and tau.numel():
        local = LocalRays(ray_bundle.origins, ray_bundle.directions, hits.local_origins, hits.local_directions)
        tau = _blend_visible(merged, flat, heads, local, field, blend_form, shares)
    survivors = keep_survivors(merged, tau, threshold, fair_share)
    order, valid = survivors.order, survivors.valid

    def pick(values: Tensor) -> Tensor:
        empty = values.new_zeros((*order.shape, *values.shape[1:]))
        return values[order] if values.shape[0] else empty

    return Kept(
        heads=pick(heads),
        planes=pick(flat.planes),
        ndc=pick(flat.ndc),
        inverse_t=torch.where(valid, pick(flat.inverse_t), 0.0),
        tau=pick(tau),
        skipped_before=survivors.skipped_before,
        valid=valid,
        skipped_total=survivors.skipped_total,
        dropped_mass=survivors.dropped_mass,
    )


def _sample_mpi(k: int, counts: Int[Tensor, "R"], hits: PlaneHits, field: MMPIField) -> _HeadSamples:
    """All live planes of head k on every ray."""
    rays, index = _enumerate(counts)
    m = hits.m_first[:, k][rays] - index
    table = torch.cat(
        [hits.u[:, k], hits.v[:, k], hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:]], -1
    ).index_select(0, rays)
    w = sample_disparity(m, field.frames.disparity_steps[k], field.frames.last_disparities[k])
    mpi = field.plan.mpis[k]
    u0, u1, v0, v1 = mpi.extent
    u = (table[:, 0] + w * table[:, 1] - u0) * (2 / (u1 - u0)) - 1
    v = (table[:, 2] + w * table[:, 3] - v0) * (2 / (v1 - v0)) - 1
    s = 1 - 2 * mpi.near / mpi.depth_share * (w - mpi.last_disparity)
    ndc = torch.stack([u, v, s], -1)
    planes = mpi.planes - 1 - m
    tau = field.mpi_optical_depth(k, planes, ndc)
    return _HeadSamples(rays, planes, ndc, inverse_distance(w, table[:, 4], table[:, 5]), tau)


def _sample_cube(first: Tensor, counts: Tensor, ray_bundle: RayBundle, field: MMPIField) -> _HeadSamples:
    """All samples inside the cube, at fixed distances from each camera."""
    assert field.cube is not None
    rays, index = _enumerate(counts)
    index = first[rays] + index
    t = (index + 0.5).to(ray_bundle.origins.dtype) * field.cube.step
    ndc = field.cube.normalised(ray_bundle.origins[rays] + ray_bundle.directions[rays] * t[:, None])
    return _HeadSamples(rays, index, ndc, 1 / t, field.cube_optical_depth(ndc))


def _enumerate(counts: Int[Tensor, "R"]) -> tuple[Int[Tensor, "N"], Int[Tensor, "N"]]:
    """(ray, 0..count-1) for every sample, ray by ray."""
    rays = torch.repeat_interleave(torch.arange(counts.shape[0], device=counts.device), counts)
    starts = counts.cumsum(0) - counts
    return rays, torch.arange(rays.shape[0], device=counts.device) - starts[rays]


def _merge(samples: list[_HeadSamples], counts: Int[Tensor, "R H"]):
    """One flat list of all samples, its heads, and their order along the rays."""
    per_ray = counts.sum(-1)
    width = max(1, int(per_ray.max())) if per_ray.numel() else 1
    before = counts.cumsum(-1) - counts
    slots = []
    for k, head in enumerate(samples):
        _, index = _enumerate(counts[:, k])
        slots.append(head.rays * width + before[:, k][head.rays] + index)
    flat = _HeadSamples(
        *(torch.cat([getattr(s, f) for s in samples]) for f in ("rays", "planes", "ndc", "inverse_t", "tau"))
    )
    heads = torch.cat([torch.full_like(s.rays, k) for k, s in enumerate(samples)])
    presorted = bool(((counts > 0).sum(-1) <= 1).all())
    return merge(torch.cat(slots), flat.inverse_t, per_ray, presorted), flat, heads


def _blend_visible(
    merged: Merged,
    flat: _HeadSamples,
    heads: Int[Tensor, "N"],
    local: LocalRays,
    field: MMPIField,
    form: BlendForm,
    shares: Float[Tensor, "N 1"] | None,
) -> Float[Tensor, "N"]:
    """Blended optical depths, front to back, until a ray lets less than exp(-OPAQUE_DEPTH) through.

    Reliability costs a lookup in every head, and most samples lie behind the first surface: those keep their own depth,
    which changes weights by less than exp(-OPAQUE_DEPTH).
    """
    tau = flat.tau.clone()
    passed = tau.new_zeros(merged.order.shape[0])
    for start in range(0, merged.order.shape[1], BLEND_BLOCK):
        order = merged.order[:, start : start + BLEND_BLOCK]
        wanted = merged.valid[:, start : start + BLEND_BLOCK] & (passed < OPAQUE_DEPTH)[:, None]
        index = order[wanted]
        if not index.numel():
            break
        baked = None if shares is None else (shares, flat.ndc[index])
        given = (flat.tau[index], flat.rays[index], local, flat.inverse_t[index], heads[index], form)
        tau[index] = field.blend(*given, baked)
        passed += torch.where(wanted, tau[order], 0.0).sum(-1)
    return tau


def _sees_all(hits: PlaneHits, counts: Int[Tensor, "R K"], field: MMPIField) -> Bool[Tensor, "R 1"]:
    """Some head sees the ray out to infinity, and the first head is entered before the first content."""
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


def _ray_samples(ray_bundle: RayBundle, kept: Kept) -> RaySamples:
    """nerfstudio's RaySamples; a sample is a point on a plane, so it starts and ends at the same distance."""
    shape = kept.valid.shape
    t = 1 / kept.inverse_t[..., None].clamp(min=DIRECTION_AT_INFINITY)
    frustums = Frustums(
        origins=ray_bundle.origins[:, None].expand(*shape, 3),
        directions=ray_bundle.directions[:, None].expand(*shape, 3),
        starts=t,
        ends=t,
        pixel_area=ray_bundle.pixel_area[:, None].expand(*shape, 1),
    )
    names = ("heads", "planes", "inverse_t", "valid", "skipped_before", "tau")
    metadata = {"ndc": kept.ndc, **{name: getattr(kept, name)[..., None] for name in names}}
    return RaySamples(frustums=frustums, camera_indices=None, metadata=metadata)
