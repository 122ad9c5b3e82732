"""Rays through one field: sampling, merging, blending, compositing and shading (docs/how_it_works.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components import renderers
from torch import Tensor

from mmpi_ns.blending import blended_optical_depth
from mmpi_ns.data.priors import Gains
from mmpi_ns.data.rays import TrainingRays
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.shading import RayShader
from mmpi_ns.field.tables import Lookup
from mmpi_ns.ops.composite import Composite, composite_weights, median_inverse_distance, winning_heads
from mmpi_ns.ops.gather import RaySums
from mmpi_ns.ops.march import MarchOptions, MergedSamples
from mmpi_ns.sampler import march, rays_of, render_fused
from mmpi_ns.scene.plan import ScenePlan

BACKGROUNDS = {"black": 0.0, "gray": 0.5, "white": 1.0}
"""Grey levels of backgrounds by name."""


def background_of(name: str, like: Tensor) -> Tensor:
    """Background colour [3]: of the viewer or a crop if set, else of this name."""
    asked = renderers.BACKGROUND_COLOR_OVERRIDE
    return like.new_full((3,), BACKGROUNDS[name]) if asked is None else asked.to(like)


class Exposures(torch.nn.Module):
    """Colours of each training image over those of the field; empty where all have the same exposure (no ``gains``)."""

    factors: Float[Tensor, "N 3"]
    falloff: Float[Tensor, "2 3"]

    def __init__(self, gains: Gains | None) -> None:
        super().__init__()
        factors, falloff = (np.zeros((0, 3)), np.zeros((2, 3))) if gains is None else (gains.from_field, gains.falloff)
        self.register_buffer("factors", torch.from_numpy(factors).float())
        self.register_buffer("falloff", torch.from_numpy(falloff).float())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes the number of images from the checkpoint; what a dictionary lacks stays, as where nerfstudio loads the
        rest of a pipeline after its model."""
        state_dict.setdefault(f"{prefix}falloff", self.falloff)
        stored = state_dict.setdefault(f"{prefix}factors", self.factors)
        self.factors = torch.empty_like(stored, device=self.factors.device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    @property
    def mean(self) -> Float[Tensor, "3"] | None:
        """Mean exposure of the training images; None where all have the field's."""
        return self.factors.log().mean(0).exp() if len(self.factors) else None


@dataclass(frozen=True)
class RenderedRays:
    """R rays with their merged samples. In training, pixel rays, then keypoint rays (both repeated for every MPI that
    renders them)."""

    bundle: RayBundle
    samples: MergedSamples
    composite: Composite
    rgb: Float[Tensor, "R 3"]
    """Without a background."""
    sums: RaySums
    """Of colours along the rays."""
    lookup: Lookup | None
    """Texels read from the field; None without gradients."""
    times: int = 1
    """Repetitions of the batch: all rays, then all rays again."""


def bounded(bundle: RayBundle, plan: ScenePlan) -> RayBundle:
    """The rays with nears and fars: ``ray_near`` of the plan and infinity, unless a crop has set tighter ones."""
    near = torch.full_like(bundle.origins[:, :1], plan.ray_near)
    bundle.nears = near if bundle.nears is None else torch.maximum(bundle.nears, near)
    # ns-render --render-nearest-camera gives whole numbers.
    bundle.fars = torch.full_like(near, torch.inf) if bundle.fars is None else bundle.fars.to(near)
    return bundle


def render_rays(
    bundle: RayBundle,
    field: MMPIField,
    options: MarchOptions,
    head_mask: Bool[Tensor, "R H"] | None = None,
    choose: Float[Tensor, "R K"] | None = None,
) -> RenderedRays:
    """Renders rays that have nears and fars, with gradients if enabled.

    Args:
        bundle: R rays.
        field: to render.
        options: which samples are kept, and how they are blended.
        head_mask: heads that may render each ray; None for all.
        choose: priorities; each ray is rendered by the MPI of highest priority among those it meets (and the cube).
    """
    with torch.no_grad():
        samples = march(field.layout, field.tables, rays_of(bundle, head_mask, choose), options)
    tau, lookup = samples.tau, None
    if torch.is_grad_enabled():
        tau, lookup = field.optical_depths(bundle, samples)
        if options.blends and tau.numel():
            tau = blended_optical_depth(tau, *field.sample_shares(bundle, samples))
    composite = composite_weights(tau, samples.starts, samples.skipped_before, samples.skipped_total)
    # Keypoint rays, whose points have a depth and no pixel, are supervised in depth alone and need no colours.
    keypoints = bundle.keypoint_disparities if isinstance(bundle, TrainingRays) and lookup is not None else None
    chosen = None if keypoints is None else keypoints[:, 0] == 0
    rgb, sums = field.render_colors(bundle, samples, lookup, composite, chosen)
    return RenderedRays(bundle, samples, composite, rgb, sums, lookup)


def render_outputs(
    bundle: RayBundle, field: MMPIField, *, blends: bool, threshold: float, head_mask: Tensor | None
) -> dict[str, Tensor]:
    """rgb (without background), accumulation, transmittance, depth, winning head and dropped mass of rays [R, .].

    Without gradients, a field that shades a ray once is rendered in one pass that stores no samples.

    Args:
        bundle: the rays.
        field: to render.
        blends: samples are blended by reliability.
        threshold: weight below which a sample is dropped.
        head_mask: heads that may render each ray; None for all.
    """
    options = MarchOptions(threshold, blends=blends)
    if isinstance(field.networks, RayShader) and not torch.is_grad_enabled():
        rays = rays_of(bundle, head_mask)
        outputs = render_fused(field.layout, field.tables, field.features.data, rays, options)
        rgb = field.networks.shade(outputs.gathered, outputs.mass, outputs.accumulation, bundle.directions)
        composite, inverse_t, winner, dropped_mass = outputs, outputs.inverse_t, outputs.winner, outputs.dropped_mass
    else:
        rendered = render_rays(bundle, field, options, head_mask)
        rgb, composite, samples = rendered.rgb, rendered.composite, rendered.samples
        inverse_t = median_inverse_distance(composite.weights, samples.inverse_t, samples.starts)
        winner = winning_heads(composite.weights, samples.heads, samples.starts, field.plan.num_heads)
        dropped_mass = samples.dropped_mass
    return {
        "rgb": rgb,
        "accumulation": composite.accumulation,
        "transmittance": composite.transmittance,
        "depth": 1 / inverse_t.clamp(min=1 / field.plan.farthest),
        "winning_mpi": winner,
        "dropped_mass": dropped_mass,
    }
