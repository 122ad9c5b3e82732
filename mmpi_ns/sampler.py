"""Sample and merge: each ray is sampled in every head's NDC, and the samples are merged by distance (paper sec. III-B).

The steps for a ray: its intersections with all planes, in closed form (``crossings``); a sample at each, in the NDC of
its head (``_intersected_samples``); all samples in order of distance (``merge``); and those with enough weight
(``prune``).
``march`` does all four without gradients: the field differentiates through the kept samples.

This is the definition in plain torch; the C++ and Triton forms are in ``ops/march``.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.blending import blended_optical_depth, log_shares
from mmpi_ns.heads import heads_of
from mmpi_ns.ops.composite import composite_weights, exclusive_cumsum, median_inverse_distance, winning_heads
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.ends import NEGLIGIBLE
from mmpi_ns.ops.gather import gather_places
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import MarchOptions, MergedSamples, RayOutputs, Rays, march_on_cpu, render_fused_on_cpu
from mmpi_ns.scene.geometry import LocalRays, PlaneHits, cube_hits, plane_hits, sample_disparity
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.settings import SamplingConfig

FAIR_SHARE = 0.1
"""While surfaces are forming, samples with more than this fraction of an equal weight are kept."""
BLEND_BLOCK = 16
"""Samples of a ray between two checks whether it is already opaque."""
OPAQUE_DEPTH = 9.2
"""Optical depth of an opaque ray: its transmittance, 1e-4, is far below the weight of a kept sample."""


def march_options(config: SamplingConfig, plan: ScenePlan, forming: bool, blends: bool) -> MarchOptions:
    """Options of the march in training: threshold of the kept samples (``prune``).

    While surfaces form, samples of little weight must learn too, and the cube starts nearly empty.
    """
    cube = 0.1 * config.cube_alpha if forming and plan.cube is not None else float("inf")
    return MarchOptions(min(config.threshold, cube), FAIR_SHARE if forming else float("inf"), blends)


def rays_of(ray_bundle: RayBundle, head_mask: Tensor | None = None, choose: Tensor | None = None) -> Rays:
    """Rays for the march, and the heads that may render them (see ``ops.march.Rays``)."""
    nears, fars = ray_bundle.nears, ray_bundle.fars
    assert nears is not None and fars is not None
    return Rays(ray_bundle.origins, ray_bundle.directions, nears, fars, head_mask, choose)


class LiveSamples(NamedTuple):
    """Flat list of samples: head by head, ray by ray, near to far."""

    rays: Int[Tensor, "N"]
    heads: Int[Tensor, "N"]
    planes: Int[Tensor, "N"]
    ndc: Float[Tensor, "N 3"]
    inverse_t: Float[Tensor, "N"]
    tau: Float[Tensor, "N"]


@operation("gpu", kernels="mmpi_ns.ops.march")
def march(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> MergedSamples:
    """Merged samples of each ray, with enough weight to be kept.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        rays: R rays.
        options: which samples are kept, and how they are blended.
    """
    hits = plane_hits(*rays[:4], layout.frames)
    first, counts, fully_covered = crossings(layout, rays, hits)
    flat = _intersected_samples(layout, tables, rays, hits, first, counts)
    per_ray = counts.sum(-1)
    order, valid = merge(flat.rays, flat.inverse_t, per_ray)
    tau = flat.tau
    if options.blends and tau.numel():
        local = LocalRays(rays.origins, rays.directions, hits.local_origins, hits.local_directions)
        tau = flat.tau.clone()
        # Front to back until the transmittance of a ray is below exp(-OPAQUE_DEPTH). Reliability costs a lookup in
        # every head, and most samples lie behind the first surface: those keep their unblended depth, which changes
        # weights by less than that. Samples too thin to matter get an equal share without one.
        passed = tau.new_zeros(order.shape[0])
        for start in range(0, order.shape[1], BLEND_BLOCK):
            block = order[:, start : start + BLEND_BLOCK]
            visible = valid[:, start : start + BLEND_BLOCK] & (passed < OPAQUE_DEPTH)[:, None]
            index = block[visible]
            if not index.numel():
                break
            depth = flat.tau[index]
            thick = (depth > NEGLIGIBLE).nonzero()[:, 0]
            sample = index[thick]
            places = (flat.rays[sample], local, flat.inverse_t[sample], flat.heads[sample])
            shares = log_shares(layout, tables.reliability, tables.touched, *places)
            blended = blended_optical_depth(depth[thick], *shares)
            tau[index] = (depth / layout.num_heads).index_copy(0, thick, blended)
            passed += torch.where(visible, tau[block], 0.0).sum(-1)
    order, valid, *skipped = prune(order, valid, tau, options.threshold, options.fair_share)
    order = torch.where(valid, order, len(tau))  # empty slots take the zeros behind the samples
    columns = (flat.heads, flat.planes, flat.ndc, flat.inverse_t, tau)
    heads, planes, ndc, inverse_t, tau = (torch.cat([x, x.new_zeros(1, *x.shape[1:])])[order] for x in columns)
    before, total, mass = skipped
    return MergedSamples(heads, planes, ndc, inverse_t, tau, before, valid, total, mass, per_ray, fully_covered)


@operation("gpu", kernels="mmpi_ns.ops.march")
def render_fused(
    layout: SceneLayout, tables: Tables, features: Float[Tensor, "T C"], rays: Rays, options: MarchOptions
) -> RayOutputs:
    """Sums of colours and features along rays, transmittance and depth: images, in one pass.

    On a GPU without synchronisation. The compiled form on a CPU processes sixteen rays at a time and skips empty tiles,
    even with a threshold of 0.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        features: colours and features of all texels (``ops.gather``).
        rays: R rays.
        options: which samples are kept, and how they are blended.
    """
    m = march(layout, tables, rays, options)
    composite = composite_weights(m.tau, m.valid, m.skipped_before, m.skipped_total)
    sums = gather_places(layout, features, m.places, composite.weights)
    return RayOutputs(
        gathered=sums.gathered,
        mass=composite.weights.sum(-1, keepdim=True),
        transmittance=composite.transmittance,
        accumulation=composite.accumulation,
        inverse_t=median_inverse_distance(composite.weights, m.inverse_t, m.valid),
        winner=winning_heads(composite.weights, m.heads, layout.num_heads),
        dropped_mass=m.dropped_mass,
    )


# Crossings -----------------------------------------------------------------------------------------------------------


def crossings(
    layout: SceneLayout, rays: Rays, hits: PlaneHits
) -> tuple[Int[Tensor, "R H"], Int[Tensor, "R H"], Bool[Tensor, "R 1"]]:
    """The samples of rays in the heads that may render them, from their intersections with all planes.

    Returns:
        m of each head's nearest intersected plane (of the cube, which comes last, its first sample), number of samples
        of each head, and ``MergedSamples.fully_covered``.
    """
    first, counts = hits.m_first, hits.count
    if rays.priorities is not None:
        met = torch.where(counts > 0, rays.priorities, torch.full_like(rays.priorities, -1.0))
        best = met.argmax(-1, keepdim=True)
        counts = torch.zeros_like(counts).scatter(1, best, counts.gather(1, best))
    if layout.cube is not None:
        start, count = cube_hits(*rays[:4], layout.cube)
        first, counts = torch.cat([first, start[:, None]], -1), torch.cat([counts, count[:, None]], -1)
    if rays.heads is not None:
        counts = torch.where(rays.heads, counts, torch.zeros_like(counts))
    fully_covered = (counts > 0).any(-1, keepdim=True)
    if rays.heads is not None or rays.priorities is not None:
        # Fully covered: some head contains the ray out to infinity, and the first head is entered before the first
        # content. The plane before the first intersected one bounds the entry; if it lies behind the camera, the ray
        # starts inside.
        intersected, frames = counts[:, : len(layout.mpis)] > 0, layout.frames
        m_before = torch.minimum(hits.m_first + 1, frames.num_planes - 1)
        w = sample_disparity(m_before, frames.disparity_steps, frames.last_disparities)
        oz, dz = hits.local_origins[..., 2], hits.local_directions[..., 2]
        starts_inside = w * oz >= 1
        entry = w * dz / torch.where(starts_inside, 1, 1 - w * oz)
        endless = intersected & (hits.m_first - counts[:, : len(layout.mpis)] < 0) & (frames.last_disparities == 0)
        entered = intersected & (starts_inside | (entry * layout.content_near >= 1))
        fully_covered &= entered.any(-1, keepdim=True) & endless.any(-1, keepdim=True)
    return first, counts, fully_covered


# Sample --------------------------------------------------------------------------------------------------------------


def _intersected_samples(
    layout: SceneLayout,
    tables: Tables,
    rays: Rays,
    hits: PlaneHits,
    first: Int[Tensor, "R H"],
    counts: Int[Tensor, "R H"],
) -> LiveSamples:
    """Samples on all intersected planes of every MPI, and inside the cube at fixed distances from each camera."""
    parts = []
    for head in heads_of(layout):
        k = head.number
        # (ray, 0..count-1) for every sample, ray by ray.
        numbers = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts[:, k])
        starts = counts[:, k].cumsum(0) - counts[:, k]
        index = torch.arange(len(numbers), device=counts.device) - starts[numbers]
        planes, ndc, inverse_t, texels = head.sample(rays, hits, numbers, index, first[:, k])
        tau = head.optical_depth(tables.density, texels, planes)
        parts.append((numbers, torch.full_like(numbers, k), planes, ndc, inverse_t, tau))
    return LiveSamples(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


# Merge ---------------------------------------------------------------------------------------------------------------


def merge(
    rays: Int[Tensor, "N"], inverse_t: Float[Tensor, "N"], counts: Int[Tensor, "R"]
) -> tuple[Int[Tensor, "R S"], Bool[Tensor, "R S"]]:
    """Sort flat samples along their rays, nearest first.

    Ties keep the order of the list, which runs over (head, plane), so the result does not depend on the batch.

    Args:
        rays: ray of each flat sample.
        inverse_t: inverse distance of each flat sample.
        counts: samples of each ray; S = counts.max().

    Returns:
        Index of each slot's sample in the flat list (0 in empty slots), and mask of the occupied slots.
    """
    by_ray, width = torch.argsort(rays, stable=True), max(1, int(counts.max())) if counts.numel() else 1
    valid = torch.arange(width, device=rays.device) < counts[:, None]
    index, keys = torch.zeros_like(valid, dtype=torch.int64), torch.full_like(valid, -1.0, dtype=inverse_t.dtype)
    index[valid], keys[valid] = by_ray, inverse_t[by_ray]
    _, nearest = torch.sort(keys, dim=-1, descending=True, stable=True)
    return index.gather(-1, nearest), valid


# Prune ---------------------------------------------------------------------------------------------------------------


def prune(
    order: Int[Tensor, "R S"], valid: Bool[Tensor, "R S"], tau: Float[Tensor, "N"], threshold: float, fair_share: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Keep the samples whose weight exceeds min(threshold, fair_share / samples on the ray).

    The second bound matters at the start, when all weights are 1/L: a fixed threshold would keep nothing, and samples
    that are not kept cannot learn.

    Args:
        order: all samples, nearest first (see ``merge``).
        valid: mask of the occupied slots.
        tau: blended optical depth of the flat samples.
        threshold: weight below which a sample is dropped once the field has sharpened; 0 keeps all.
        fair_share: the bound relative to equal weights; inf for the threshold alone.

    Returns:
        ``order`` and ``valid`` of the kept samples, packed to the left, and ``skipped_before``, ``skipped_total`` and
        ``dropped_mass`` of ``MergedSamples``.
    """
    depth = torch.where(valid, tau[order] if tau.numel() else 0.0, 0.0)
    weights = torch.exp(-exclusive_cumsum(depth)) * -torch.expm1(-depth)
    bound = (fair_share / valid.sum(-1, keepdim=True).clamp(min=1)).clamp(max=threshold)
    kept = valid & (weights > bound) if threshold > 0 else valid
    skipped = torch.where(kept, 0.0, depth)
    width = max(1, int(kept.sum(-1).max())) if kept.numel() else 1
    packed = torch.argsort((~kept).to(torch.int8), dim=-1, stable=True)[:, :width]
    there = kept.gather(-1, packed)
    before = torch.where(there, exclusive_cumsum(skipped).gather(-1, packed), 0.0)
    mass = torch.where(kept, 0.0, weights).sum(-1, keepdim=True)
    return order.gather(-1, packed), there, before, skipped.sum(-1, keepdim=True), mass


march.on_cpu(march_on_cpu)
render_fused.on_cpu(render_fused_on_cpu)
