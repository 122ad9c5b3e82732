"""Images of a field that is shaded once a ray, from rays to colours without gradients."""

from __future__ import annotations

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.shading import RayShader
from mmpi_ns.ops import dispatch
from mmpi_ns.ops.march import MarchOptions, show_rays
from mmpi_ns.rendering.rendered import distances_of
from mmpi_ns.rendering.sampler import rays_of


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
