"""Renders rays through one field: sampling, merging, blending, compositing and shading (docs/how_it_works.md)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle, RaySamples
from torch import Tensor

from mmpi_ns.capture.ray_sources import is_pixel_ray
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import Lookup, metadata_of
from mmpi_ns.ops.blending import blended_optical_depth
from mmpi_ns.ops.composite import composite_weights, winning_heads
from mmpi_ns.rendering.rendered import RenderedRays, median_distance
from mmpi_ns.rendering.sampler import MergeReport, MMPISampler


def render_rays(
    sampler: MMPISampler, bundle: RayBundle, field: MMPIField, *, blends: bool, **sampling: Any
) -> RenderedRays:
    """Renders rays that have nears and fars, with gradients if enabled.

    Args:
        sampler: samples and merges.
        bundle: the rays.
        field: to render.
        blends: samples are blended by reliability.
        sampling: further arguments of the sampler.
    """
    samples, report = sampler(bundle, field=field, blends=blends, **sampling)
    tau, lookup = _optical_depth(field, samples, report, blends)
    meta = metadata_of(samples)
    valid, before = meta["valid"][..., 0], meta["skipped_before"][..., 0]
    composite = composite_weights(tau, valid, before, report.skipped_total)
    # Keypoint rays are supervised in depth alone: no colours for them.
    colors = field.render_colors(samples, lookup, composite, lookup and is_pixel_ray(bundle))
    return RenderedRays(bundle, samples, composite, colors, report, lookup)


def _optical_depth(
    field: MMPIField, samples: RaySamples, report: MergeReport, blends: bool
) -> tuple[Float[Tensor, "R S"], Lookup | None]:
    """(Blended) optical depths, with gradients if enabled; otherwise the sampler's own, without a lookup."""
    if not torch.is_grad_enabled():
        return metadata_of(samples)["tau"][..., 0], None
    density, lookup = field.get_density(samples, report.head_counts)
    tau = density[..., 0]
    if blends and lookup.index.numel():
        shares = field.sample_shares(samples, lookup)
        blended = blended_optical_depth(tau.reshape(-1)[lookup.index], *shares)
        tau = tau.new_zeros(tau.numel()).index_put((lookup.index,), blended).view(tau.shape)
    return tau, lookup


def images_of(rays: RenderedRays, field: MMPIField) -> dict[str, Tensor]:
    """Outputs of rays for nerfstudio: colour without a background, accumulation, depth."""
    return {
        "rgb": rays.colors.rgb,
        "accumulation": rays.composite.accumulation,
        "depth": median_distance(rays.composite, rays.samples, field.plan),
    }


def sampled_outputs(bundle: RayBundle, field: MMPIField, *, blends: bool, **sampling: Any) -> dict[str, Tensor]:
    """``shown.shown_outputs`` for any field, also with gradients."""
    rays = render_rays(MMPISampler(), bundle, field, blends=blends, **sampling)
    heads, composite = metadata_of(rays.samples)["heads"][..., 0], rays.composite
    return images_of(rays, field) | {
        "transmittance": composite.transmittance,
        "winning_mpi": winning_heads(composite.weights, heads, field.plan.num_heads),
        "dropped_mass": rays.report.dropped_mass,
    }
