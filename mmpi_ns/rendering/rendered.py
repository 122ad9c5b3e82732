"""Rays after rendering: their samples, with weights and colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.model_components import renderers
from torch import Tensor

from mmpi_ns.field.samples import Lookup
from mmpi_ns.field.shading import RayColors
from mmpi_ns.ops.composite import Composite
from mmpi_ns.rendering.sampler import MergeReport
from mmpi_ns.scene.plan import ScenePlan

BACKGROUNDS = {"black": 0.0, "gray": 0.5, "white": 1.0}
"""Names of backgrounds."""


def background_of(name: str, like: Tensor) -> Tensor:
    """Background colour [3]: that of the viewer or a crop if set, else the one of this name."""
    asked = renderers.BACKGROUND_COLOR_OVERRIDE
    return like.new_full((3,), BACKGROUNDS[name]) if asked is None else asked.to(like)


@dataclass
class RenderingConfig:
    """Images: ``--pipeline.model.rendering.*``."""

    mode: Literal["auto", "exact", "baked"] = "auto"
    """Render the field itself (exact), or 8-bit texels baked from it before the first image (baked: half of the time on
    a CPU, 0.01 dB less; docs/export.md). auto: baked for ns-render and ns-viewer on a CPU if the model can be baked;
    exact during training, in ns-eval and on a GPU."""
    threshold: float = 3e-3
    """Samples of less weight are not shaded when rendering; their total weight is reported (dropped_mass)."""
    background: Literal["black", "gray", "white"] = "gray"
    """Background when rendering. Training uses random colours where the MPIs cover the whole ray."""
    exposure: Literal["mean", "nearest"] = "mean"
    """Exposure of images where that of the training images differs: their mean, so that films do not flicker, or that
    of the training image taken nearest (rendered exactly)."""
    resident_gib: float = 2.0
    """Device memory for rendering the windows of a long capture, GiB, in addition to the one trained last. As many as
    fit are kept, at least one; the least recently used is evicted first."""
    half_windows: bool = False
    """Write the finished windows of a long capture in half precision: half of the disk space; images change by a
    fraction of a grey level."""


@dataclass(frozen=True)
class RenderedRays:
    """R rays with S merged samples each. In training, pixel rays, then keypoint rays (both repeated for every MPI that
    renders them)."""

    bundle: RayBundle
    samples: RaySamples
    composite: Composite
    colors: RayColors
    report: MergeReport
    lookup: Lookup | None
    """Texels read from the field; None without gradients."""
    times: int = 1
    """Repetitions of the batch: all rays, then all rays again."""


def bounded(bundle: RayBundle, plan: ScenePlan) -> RayBundle:
    """The rays with nears and fars: ``ray_near`` of the plan and infinity, unless a crop has set tighter ones."""
    near = torch.full_like(bundle.origins[:, :1], plan.ray_near)
    bundle.nears = near if bundle.nears is None else torch.maximum(bundle.nears, near)
    bundle.fars = torch.full_like(near, torch.inf) if bundle.fars is None else bundle.fars
    return bundle


def distances_of(inverse_t: Float[Tensor, "R 1"], plan: ScenePlan) -> Float[Tensor, "R 1"]:
    """Distances from inverse ones; infinity becomes ten times the farthest finite plane."""
    farthest = 10 * max(m.farthest for m in plan.mpis)
    return 1 / inverse_t.clamp(min=1 / farthest)
