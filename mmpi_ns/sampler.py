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
from torch.nn.functional import pad

from mmpi_ns.blending import blended_optical_depth, log_shares
from mmpi_ns.heads import heads_of
from mmpi_ns.ops.composite import (
    composite_weights,
    median_inverse_distance,
    ray_numbers,
    sum_before,
    sum_by_ray,
    winning_heads,
)
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.ends import NEGLIGIBLE
from mmpi_ns.ops.gather import Taps, gather_taps
from mmpi_ns.ops.interpolate import texel_rows
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import MarchOptions, MergedSamples, RayOutputs, Rays, march_on_cpu, render_fused_on_cpu
from mmpi_ns.scene.geometry import PlaneHits, cube_hits, plane_hits, sample_disparity
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
    order, starts = merge(flat.rays, flat.inverse_t), pad(per_ray.cumsum(0), (1, 0))
    tau = flat.tau
    if options.blends and tau.numel():
        tau = flat.tau.clone()
        # Front to back until the transmittance of a ray is below exp(-OPAQUE_DEPTH). Reliability costs a lookup in
        # every head, and most samples lie behind the first surface: those keep their unblended depth, which changes
        # weights by less than that. Samples too thin to matter get an equal share without one.
        passed, numbers = tau.new_zeros(len(per_ray)), flat.rays[order]
        blocks = (torch.arange(len(order), device=order.device) - starts[numbers]) // BLEND_BLOCK
        for block in range(int(blocks.max()) + 1):
            index = order[(blocks == block) & (passed < OPAQUE_DEPTH)[numbers]]
            if not index.numel():
                break
            depth = flat.tau[index]
            thick = (depth > NEGLIGIBLE).nonzero()[:, 0]
            sample = index[thick]
            origins, directions = (x[flat.rays[sample]] for x in rays[:2])
            shares = log_shares(layout, tables, origins, directions, flat.inverse_t[sample], flat.heads[sample])
            blended = blended_optical_depth(depth[thick], *shares)
            tau[index] = (depth / layout.num_heads).index_copy(0, thick, blended)
            passed.index_add_(0, flat.rays[index], tau[index])
    kept, before, starts, total, mass = prune(tau[order], starts, options.threshold, options.fair_share)
    columns = (flat.heads, flat.planes, flat.ndc, flat.inverse_t, tau)
    heads, planes, ndc, inverse_t, tau = (x[order[kept]] for x in columns)
    return MergedSamples(heads, planes, ndc, inverse_t, tau, before, starts, total, mass, per_ray, fully_covered)


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
    composite = composite_weights(m.tau, m.starts, m.skipped_before, m.skipped_total)
    texels = Taps(*texel_rows(layout, m.heads, m.planes, m.ndc))
    sums = gather_taps(features, texels, m.starts, composite.weights)
    return RayOutputs(
        gathered=sums.gathered,
        mass=sums.mass,
        transmittance=composite.transmittance,
        accumulation=composite.accumulation,
        inverse_t=median_inverse_distance(composite.weights, m.inverse_t, m.starts),
        winner=winning_heads(composite.weights, m.heads, m.starts, layout.num_heads),
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


def merge(rays: Int[Tensor, "N"], inverse_t: Float[Tensor, "N"]) -> Int[Tensor, "N"]:
    """Indices of samples by ray, and along each ray nearest first.

    Ties keep the order of the list, which runs over (head, plane), so the result does not depend on the batch.

    Args:
        rays: ray of each sample.
        inverse_t: inverse distance of each sample.
    """
    nearest = torch.argsort(inverse_t, descending=True, stable=True)
    return nearest[torch.argsort(rays[nearest], stable=True)]


# Prune ---------------------------------------------------------------------------------------------------------------


def prune(
    tau: Float[Tensor, "N"], starts: Int[Tensor, "R+1"], threshold: float, fair_share: float
) -> tuple[Int[Tensor, "K"], Tensor, Tensor, Tensor, Tensor]:
    """Keep the samples whose weight exceeds min(threshold, fair_share / samples on the ray).

    The second bound matters at the start, when all weights are 1/L: a fixed threshold would keep nothing, and samples
    that are not kept cannot learn.

    Args:
        tau: blended optical depth of all merged samples.
        starts: of the rays' samples.
        threshold: weight below which a sample is dropped once the field has sharpened; 0 keeps all.
        fair_share: the bound relative to equal weights; inf for the threshold alone.

    Returns:
        Indices of the kept samples, and ``skipped_before``, ``starts``, ``skipped_total`` and ``dropped_mass`` of
        ``MergedSamples``.
    """
    numbers = ray_numbers(starts, len(tau))
    weights = torch.exp(-sum_before(tau, starts, numbers)).to(tau.dtype) * -torch.expm1(-tau)
    bound = (fair_share / starts.diff().clamp(min=1)).clamp(max=threshold)
    kept = weights > bound[numbers] if threshold > 0 else torch.ones_like(weights, dtype=torch.bool)
    skipped, index = torch.where(kept, 0.0, tau), kept.nonzero()[:, 0]
    before = sum_before(skipped, starts, numbers)[index].to(tau.dtype)
    total, mass = (
        sum_by_ray(x.double()[:, None], starts, numbers).to(tau.dtype)
        for x in (skipped, torch.where(kept, 0.0, weights))
    )
    return index, before, pad(kept.cumsum(0), (1, 0))[starts], total, mass


march.on_cpu(march_on_cpu)
render_fused.on_cpu(render_fused_on_cpu)
