"""Rays through one field: sampling, merging, blending, compositing and shading (docs/how_it_works.md)."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.capture.ray_sources import is_pixel_ray
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import metadata_of
from mmpi_ns.field.shading import RayShader
from mmpi_ns.ops import dispatch
from mmpi_ns.ops.blending import blended_optical_depth
from mmpi_ns.ops.composite import composite_weights, median_inverse_distance, winning_heads
from mmpi_ns.ops.march import MarchOptions, show_rays
from mmpi_ns.rendering.rendered import RenderedRays, distances_of
from mmpi_ns.rendering.sampler import MMPISampler, rays_of


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
    meta, lookup = metadata_of(samples), None
    tau = meta["tau"][..., 0]  # the sampler's own, without gradients
    if torch.is_grad_enabled():
        density, lookup = field.get_density(samples, report.head_counts)
        tau = density[..., 0]
        if blends and lookup.index.numel():
            shares = field.sample_shares(samples, lookup)
            blended = blended_optical_depth(tau.reshape(-1)[lookup.index], *shares)
            tau = tau.new_zeros(tau.numel()).index_put((lookup.index,), blended).view(tau.shape)
    valid, before = meta["valid"][..., 0], meta["skipped_before"][..., 0]
    composite = composite_weights(tau, valid, before, report.skipped_total)
    # Keypoint rays are supervised in depth alone: no colours for them.
    colors = field.render_colors(samples, lookup, composite, lookup and is_pixel_ray(bundle))
    return RenderedRays(bundle, samples, composite, colors, report, lookup)


def sampled_outputs(bundle: RayBundle, field: MMPIField, *, blends: bool, **sampling: Any) -> dict[str, Tensor]:
    """``shown_outputs`` for any field, also with gradients."""
    rays = render_rays(MMPISampler(), bundle, field, blends=blends, **sampling)
    meta, composite = metadata_of(rays.samples), rays.composite
    with torch.no_grad():
        inverse_t = median_inverse_distance(composite.weights, meta["inverse_t"][..., 0], meta["valid"][..., 0])
    return {
        "rgb": rays.colors.rgb,
        "accumulation": composite.accumulation,
        "transmittance": composite.transmittance,
        "depth": distances_of(inverse_t, field.plan),
        "winning_mpi": winning_heads(composite.weights, meta["heads"][..., 0], field.plan.num_heads),
        "dropped_mass": rays.report.dropped_mass,
    }


def shows_in_one_pass(field: MMPIField) -> bool:
    """Whether a compiled form renders images of a field in one pass, without arrays of samples."""
    return field.shading == "ray" and dispatch.form_of("show_rays", field.features) != "reference"


@torch.no_grad()
def shown_outputs(
    bundle: RayBundle,
    field: MMPIField,
    *,
    blends: bool,
    threshold: float,
    head_mask: Tensor | None,
) -> dict[str, Tensor]:
    """rgb (without background), accumulation, transmittance, depth, winning head and dropped mass of rays [R, .].

    Args:
        bundle: the rays.
        field: with ``shading ray``.
        blends: samples are blended by reliability.
        threshold: weight below which a sample is dropped.
        head_mask: heads that may render each ray; None for all.
    """
    assert isinstance(field.networks, RayShader)
    options = MarchOptions(threshold, blends=blends)
    scene = (field.layout, field.tables, field.features.data)
    shown = show_rays(*scene, rays_of(bundle, head_mask), options)
    return {
        "rgb": field.networks.shade(shown.gathered, shown.mass, shown.accumulation, bundle.directions),
        "accumulation": shown.accumulation,
        "transmittance": shown.transmittance,
        "depth": distances_of(shown.inverse_t, field.plan),
        "winning_mpi": shown.winner,
        "dropped_mass": shown.dropped_mass,
    }
