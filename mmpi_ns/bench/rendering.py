"""Rays through a field by the package's own parts, put together as the model does: sampler, field, compositing."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from torch import Tensor

from mmpi_ns.bench.stability.exact import Array
from mmpi_ns.bench.trainings import evenly
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import metadata_of
from mmpi_ns.ops.blending import BlendForm, blended_optical_depth
from mmpi_ns.ops.composite.reference import Composite, composite_weights, median_inverse_distance
from mmpi_ns.rendering.sampler import MergeReport, MMPISampler

Image = tuple[Any, Tensor]
"""A test camera and its image [H, W, 3]."""


def images_of(pipeline: Any, count: int = 0) -> Iterator[Image]:
    """Test images of a finished run, evenly spaced; 0 for all."""
    data, device = pipeline.datamanager.eval_dataset, pipeline.model.device
    for i in evenly(len(data), count):
        yield data.cameras[i : i + 1].to(device), data.get_image_float32(i)[..., :3]


@dataclass(frozen=True)
class Rendered:
    """R rays, without background."""

    rgb: Tensor
    """[R, 3]"""
    composite: Composite
    samples: RaySamples
    report: MergeReport

    def median_inverse_distance(self) -> Tensor:
        """1/t at half the gathered mass [R]."""
        meta = metadata_of(self.samples)
        inverse_t, valid = meta["inverse_t"][..., 0], meta["valid"][..., 0]
        return median_inverse_distance(self.composite.weights, inverse_t, valid)[:, 0]


def bundle_of(origins: Array, directions: Array, near: float = 0.05, far: float = math.inf) -> RayBundle:
    """float32 rays from arrays [R, 3]."""
    o, d = (torch.tensor(np.atleast_2d(x), dtype=torch.float32) for x in (origins, directions))
    column = torch.ones(len(o), 1)
    return RayBundle(origins=o, directions=d, pixel_area=column * 1e-4, nears=near * column, fars=far * column)


def render(
    field: MMPIField,
    rays: RayBundle,
    threshold: float = 0.0,
    form: BlendForm | None = None,
    fair_share: float = math.inf,
    known_lookup: bool = True,
) -> Rendered:
    """Colour of rays; differentiable by the field's tables.

    Args:
        field: what is rendered.
        rays: R of them.
        threshold: weight below which samples are not coloured.
        form: of blending; None: no reliability.
        fair_share: of a ray's samples, as for the sampler.
        known_lookup: colours by what the densities were looked up with, as in training; else as in rendering.
    """
    samples, report = MMPISampler()(rays, field=field, threshold=threshold, fair_share=fair_share, blend_form=form)
    tau, lookup = field.get_density(samples)
    tau = tau[..., 0]
    if form is not None and lookup.index.numel():
        blended = blended_optical_depth(tau.reshape(-1)[lookup.index], *field.sample_shares(samples, lookup), form)
        tau = tau.new_zeros(tau.numel()).index_put((lookup.index,), blended).view(tau.shape)
    meta = metadata_of(samples)
    made = composite_weights(tau, meta["valid"][..., 0], meta["skipped_before"][..., 0], report.skipped_total)
    return Rendered(field.render_colors(samples, lookup if known_lookup else None, made).rgb, made, samples, report)
