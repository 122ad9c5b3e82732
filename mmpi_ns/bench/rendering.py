"""Rays as arrays through the package's own renderer, and what of its intermediate results the benchmarks look at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import metadata_of
from mmpi_ns.rendering.render import render_rays
from mmpi_ns.rendering.rendered import RenderedRays
from mmpi_ns.rendering.sampler import MMPISampler

Array = NDArray[Any]
"""Of float64; numpy's stubs lose that in too many operations to say so."""


def bundle_of(origins: Array, directions: Array, near: float = 0.05, far: float = math.inf) -> RayBundle:
    """float32 rays from arrays [R, 3]."""
    o, d = (torch.tensor(np.atleast_2d(x), dtype=torch.float32) for x in (origins, directions))
    column = torch.ones(len(o), 1)
    return RayBundle(origins=o, directions=d, pixel_area=column * 1e-4, nears=near * column, fars=far * column)


def in_float64(bundle: RayBundle) -> RayBundle:
    """The rays on the CPU in float64, for which every operation has its reference in plain torch alone."""
    names = ("origins", "directions", "pixel_area", "nears", "fars")
    return RayBundle(**{name: getattr(bundle, name).cpu().double() for name in names})


def render(
    field: MMPIField, rays: RayBundle, threshold: float = 0.0, blends: bool = False, **sampling: Any
) -> RenderedRays:
    """Rays without background; with gradients, or as images are rendered where none are wanted."""
    return render_rays(MMPISampler(), rays, field, blends=blends, threshold=threshold, **sampling)


def of_slots(found: RenderedRays, name: str) -> Tensor:
    """What is known of each sample, by its name in the metadata [R, S]."""
    return metadata_of(found.samples)[name][..., 0]
