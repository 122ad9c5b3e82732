"""Sample and merge (paper sec. III-B): all heads of a ray at once, front to back, to the samples that matter.

Free of gradients: the field differentiates through the samples that are kept. The compiled forms take the nearest of
all heads' next samples at each step, and end a ray where less than 1e-5 of its light is left (and less than a sample
must weigh to be kept), so a ray costs what lies in front of its first surfaces.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.blending import blended_optical_depth, log_shares
from mmpi_ns.ops.build import OPS, call_in_parts, structs
from mmpi_ns.ops.composite import composite_weights, exclusive_cumsum, median_inverse_distance, winning_heads
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.ends import NEGLIGIBLE
from mmpi_ns.ops.gather import gather_places
from mmpi_ns.ops.interpolate import interpolate
from mmpi_ns.ops.layout import SceneLayout, Tables, dense, dense_fields
from mmpi_ns.ops.march.rays import Capacity as Capacity
from mmpi_ns.ops.march.rays import MarchOptions, MergedSamples, Rays, Shown, empty_samples
from mmpi_ns.scene.columns import columns_from
from mmpi_ns.scene.geometry import LocalRays, PlaneHits, cube_hits, inverse_distance, plane_hits, sample_disparity

BLEND_BLOCK = 16
"""Samples of a ray between two checks whether it is already opaque."""
OPAQUE_DEPTH = 9.2
"""exp(-9.2) = 1e-4 of the light: far below the weight of a kept sample."""


class LiveSamples(NamedTuple):
    """A flat list of live samples: head by head, ray by ray, near to far."""

    rays: Int[Tensor, "N"]
    heads: Int[Tensor, "N"]
    planes: Int[Tensor, "N"]
    ndc: Float[Tensor, "N 3"]
    inverse_t: Float[Tensor, "N"]
    tau: Float[Tensor, "N"]


@operation("gpu")
def march(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> MergedSamples:
    """The samples of each ray that matter.

    Args:
        layout: the scene.
        tables: densities, reliabilities and which texels were trained.
        rays: R rays.
        options: which samples are kept, and how they are blended.
    """
    hits = plane_hits(*rays[:4], layout.frames)
    first, counts, explained = crossings(layout, rays, hits)
    flat = _live_samples(layout, tables, rays, hits, first, counts)
    per_ray = counts.sum(-1)
    order, valid = merge(flat.rays, flat.inverse_t, per_ray)
    tau = flat.tau
    if options.blends and tau.numel():
        local = LocalRays(rays.origins, rays.directions, hits.local_origins, hits.local_directions)
        tau = flat.tau.clone()
        # Front to back until a ray lets less than exp(-OPAQUE_DEPTH) through. Reliability costs a lookup in every head,
        # and most samples lie behind the first surface: those keep their own depth, which changes weights by less than
        # that. Samples too thin to matter get an equal share without one.
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
    return MergedSamples(heads, planes, ndc, inverse_t, tau, before, valid, total, mass, per_ray, explained)


@operation("gpu")
def show_rays(
    layout: SceneLayout, tables: Tables, features: Float[Tensor, "T C"], rays: Rays, options: MarchOptions
) -> Shown:
    """What rays gather of colours and features, how much light they let through, and where: pictures, in one pass.

    On a GPU nothing is waited for. The compiled form on a CPU takes sixteen rays abreast and passes over tiles that are
    not stored, also where the threshold is 0.

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
    return Shown(
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
    """The live samples of rays in the heads that may answer them, from their crossings with all planes.

    Returns:
        m of each head's nearest live plane (of the cube, which comes last, its first sample), how many live samples
        each head has, and ``MergedSamples.explained``.
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
    explained = (counts > 0).any(-1, keepdim=True)
    if rays.heads is not None or rays.priorities is not None:
        # Some head covers the ray out to infinity, and the first one is entered before the first content. One plane
        # before the first live one bounds the entry: behind the camera means that the ray starts inside.
        live, frames = counts[:, : len(layout.mpis)] > 0, layout.frames
        m_before = torch.minimum(hits.m_first + 1, frames.num_planes - 1)
        w = sample_disparity(m_before, frames.disparity_steps, frames.last_disparities)
        oz, dz = hits.local_origins[..., 2], hits.local_directions[..., 2]
        starts_inside = w * oz >= 1
        entry = torch.where(starts_inside, torch.inf, w * dz / torch.where(starts_inside, 1, 1 - w * oz))
        endless = live & (hits.m_first - counts[:, : len(layout.mpis)] < 0) & (frames.last_disparities == 0)
        explained &= (live & (entry * layout.content_near >= 1)).any(-1, keepdim=True)
        explained &= endless.any(-1, keepdim=True)
    return first, counts, explained


# Sample --------------------------------------------------------------------------------------------------------------


def _live_samples(
    layout: SceneLayout,
    tables: Tables,
    rays: Rays,
    hits: PlaneHits,
    first: Int[Tensor, "R H"],
    counts: Int[Tensor, "R H"],
) -> LiveSamples:
    """All live planes of every MPI, and the samples inside the cube, at fixed distances from each camera."""
    parts, frames = [], layout.frames
    for k, grid in enumerate(layout.grids):
        # (ray, 0..count-1) for every sample, ray by ray.
        numbers = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts[:, k])
        starts = counts[:, k].cumsum(0) - counts[:, k]
        index = torch.arange(len(numbers), device=counts.device) - starts[numbers]
        if k < len(layout.mpis):
            m, mpi = first[:, k][numbers] - index, layout.mpis[k]
            ray = torch.cat(
                [hits.u[:, k], hits.v[:, k], hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:]], -1
            ).index_select(0, numbers)
            w = sample_disparity(m, frames.disparity_steps[k], frames.last_disparities[k])
            u0, u1, v0, v1 = mpi.extent
            u = (ray[:, 0] + w * ray[:, 1] - u0) * (2 / (u1 - u0)) - 1
            v = (ray[:, 2] + w * ray[:, 3] - v0) * (2 / (v1 - v0)) - 1
            ndc = torch.stack([u, v, 1 - 2 * mpi.near / mpi.depth_share * (w - 1 / mpi.far)], -1)
            planes, inverse_t = mpi.planes - 1 - m, inverse_distance(w, ray[:, 4], ray[:, 5])
            texels = grid.bilinear(planes, ndc)
        else:
            assert layout.cube is not None
            planes = first[:, k][numbers] + index
            t = (planes + 0.5).to(rays.origins.dtype) * layout.cube.step
            points = rays.origins[numbers] + rays.directions[numbers] * t[:, None]
            ndc, inverse_t = layout.cube.normalised(points), 1 / t
            texels = grid.trilinear(ndc)
        tau = layout.optical_depth(k, interpolate(tables.density, *texels)[:, 0], planes)
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
        Index of each slot's sample in the flat list (0 in empty slots), and which slots hold one.
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
        valid: which slots hold one.
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


# On a CPU ------------------------------------------------------------------------------------------------------------


def shown(name: str, num_rays: int, channels: int, *values: Any, folder: Path = OPS) -> Shown:
    """What a compiled function of ``(begin, end, *values, outputs)`` shows (see ``build.call_in_parts``)."""
    outputs = [torch.empty(num_rays, n) for n in (channels, 1, 1, 1, 1, 1, 1)]
    call_in_parts(name, num_rays, *values, structs(outputs), folder=folder)
    return Shown(*outputs)


@march.on_cpu
def march_on_cpu(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> MergedSamples:
    num_rays, room = len(rays.origins), options.most_kept(layout.most_samples)
    samples = structs(empty_samples(num_rays * room, index=torch.int32))
    starts, kept, live = torch.empty(3, num_rays, dtype=torch.int64)
    explained, (skipped, dropped) = torch.empty(num_rays, 1, dtype=torch.bool), torch.empty(2, num_rays, 1)
    walk = (layout.cpu_scene(tables), structs(dense_fields(rays)))
    how = (float(options.threshold), float(options.fair_share), options.blends)
    call_in_parts("mmpi_march", num_rays, *walk, room, *how, starts, kept, live, explained, skipped, dropped, samples)
    width = max(1, int(kept.max())) if num_rays else 1
    slots = [*empty_samples(num_rays, width), torch.empty(num_rays, width, dtype=torch.bool)]
    call_in_parts("mmpi_pack", num_rays, starts, kept, width, samples, structs(slots))
    return MergedSamples(*slots, skipped_total=skipped, dropped_mass=dropped, live=live, explained=explained)


@show_rays.on_cpu
def show_rays_on_cpu(layout: SceneLayout, tables: Tables, features: Tensor, rays: Rays, options: MarchOptions) -> Shown:
    if "tiles" not in layout.packed:
        # Rays pass over tiles from which nothing can be read: where the lower corner of four texels is in any other,
        # one of them is stored.
        columns, bricks, count = [torch.zeros(0, 2, dtype=torch.int32)], [torch.zeros(1, 4, dtype=torch.int32)], 0
        for grid in layout.grids[: len(layout.mpis)]:
            tiles = pad(grid.own_tiles, (0, 1, 0, 1))
            down, across = ((n - 2) // 8 + 1 for n in (grid.height, grid.width))  # of lower corners
            corners = torch.stack([tiles[:, y : y + down, x : x + across] for y in (0, 1) for x in (0, 1)], -1)
            stored, places = columns_from((corners > 0).any(-1), count)
            columns.append(stored)
            bricks.append(corners[tuple(places.T)])
            count += len(places)
        layout.packed.setdefault("tiles", structs((torch.cat(columns), torch.cat(bricks[1:] + bricks[:1]))))
    walk = (layout.cpu_scene(tables), structs(dense_fields(rays)))
    texels = (layout.packed["tiles"], *dense(features), *features.shape)
    how = (float(options.threshold), float(options.fair_share), options.blends)
    return shown("mmpi_show", len(rays.origins), features.shape[1], *walk, *texels, *how)
