"""Compiled forms of sampling and merging (``mmpi_ns/sampler.py`` defines both in torch): C++ here, Triton in ``gpu``.

Each step takes the nearest of all heads' next samples. A ray terminates where its transmittance falls below 1e-5 (and
below the weight of a kept sample), so its cost is that of the samples in front of its first surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import OPS, call_in_parts, structs
from mmpi_ns.ops.layout import Places, SceneLayout, Tables, dense, dense_fields
from mmpi_ns.scene.bricks import columns_from


class Rays(NamedTuple):
    """R rays, and the heads that may render them."""

    origins: Float[Tensor, "R 3"]
    """World axes, scene units."""
    directions: Float[Tensor, "R 3"]
    """Unit, world axes."""
    nears: Float[Tensor, "R 1"]
    """Distance at which rays start."""
    fars: Float[Tensor, "R 1"]
    """Distance at which rays end; may be inf."""
    heads: Bool[Tensor, "R H"] | None = None
    """Heads that may render each ray; None for all."""
    priorities: Float[Tensor, "R K"] | None = None
    """Priorities of the MPIs: the intersected one of highest priority renders (and the cube). None: all."""


class Capacity(NamedTuple):
    """Capacity for the samples of a training batch, which fixes the sizes of its arrays before the march."""

    slots: int
    """Slots of each ray; the last one stays empty."""
    heads: tuple[int, ...]
    """Samples of each head."""
    rows: int
    """Distinct rows of the tables."""


class MarchOptions(NamedTuple):
    """Pruning and blending of samples."""

    threshold: float
    """Weight below which a sample is pruned; 0 keeps all samples, and no ray terminates early."""
    fair_share: float = float("inf")
    """Bound on the threshold relative to equal weights (``march.prune``)."""
    blends: bool = False
    """Samples are blended by reliability."""
    capacity: Capacity | None = None
    """On a GPU: the sizes of the result, which avoids synchronisation. Samples beyond them are dropped (see
    ``MergedSamples.numbers``). None: as many as needed."""

    def most_kept(self, samples: int) -> int:
        """Maximum number of kept samples of a ray: weights sum to at most 1, and each exceeds the bound."""
        if self.threshold <= 0:
            return samples
        return min(samples, int(1.01 / min(self.threshold, self.fair_share / max(samples, 1))) + 2)


@dataclass(frozen=True)
class MergedSamples:
    """The kept samples of R rays, nearest first in S slots of each ray, and the attenuation by the pruned ones."""

    heads: Int[Tensor, "R S"]
    """0 in empty slots, like all fields."""
    planes: Int[Tensor, "R S"]
    ndc: Float[Tensor, "R S 3"]
    inverse_t: Float[Tensor, "R S"]
    tau: Float[Tensor, "R S"]
    """Optical depth, blended if reliability is used."""
    skipped_before: Float[Tensor, "R S"]
    """Optical depth of the dropped samples in front of each sample."""
    valid: Bool[Tensor, "R S"]
    skipped_total: Float[Tensor, "R 1"]
    dropped_mass: Float[Tensor, "R 1"]
    """Sum of the weights of the dropped samples."""
    num_intersected: Int[Tensor, "R"]
    """Planes and voxels intersected by each ray: its samples before pruning."""
    fully_covered: Bool[Tensor, "R 1"]
    """Whether the allowed heads cover the ray from before the first content out to infinity, or all heads are allowed
    and one is intersected. Such a ray must reproduce its whole pixel."""
    head_counts: tuple[int, ...] | None = None
    """Samples of each head, if available without synchronisation; with a capacity, the capacity of each head."""
    capacity: Capacity | None = None
    """See ``MarchOptions``."""
    numbers: Int[Tensor, "1+H"] | None = None
    """Largest number of kept samples of a ray, then that of each head; only with a capacity."""

    @property
    def places(self) -> Places:
        return Places(self.heads, self.planes, self.ndc, self.valid)


def empty_samples(*shape: int, index: torch.dtype = torch.int64, device: torch.device | str = "cpu") -> list[Tensor]:
    """Arrays for heads, planes, NDC, inverse distances, optical depths and those skipped before each sample."""
    types = (index, index, *[torch.float32] * 4)
    return [torch.empty((*shape, 3) if i == 2 else shape, dtype=t, device=device) for i, t in enumerate(types)]


@dataclass(frozen=True)
class RayOutputs:
    """Outputs of rays that are rendered in one pass, without arrays of samples."""

    gathered: Float[Tensor, "R C"]
    """Sums of weight times colour and features of the kept samples."""
    mass: Float[Tensor, "R 1"]
    """Sum of their weights."""
    transmittance: Float[Tensor, "R 1"]
    """Behind the last sample; of baked rays 0 where it is at most ``ends.OPAQUE_BAKED``."""
    accumulation: Float[Tensor, "R 1"]
    inverse_t: Float[Tensor, "R 1"]
    """At half the mass (``ops.composite.median_inverse_distance``); 0 for infinity, or without mass."""
    winner: Float[Tensor, "R 1"]
    """The head with the largest share of the mass."""
    dropped_mass: Float[Tensor, "R 1"]


def ray_outputs(name: str, num_rays: int, channels: int, *values: Any, folder: Path = OPS) -> RayOutputs:
    """Outputs of a compiled function of ``(begin, end, *values, outputs)`` (see ``build.call_in_parts``)."""
    outputs = [torch.empty(num_rays, n) for n in (channels, 1, 1, 1, 1, 1, 1)]
    call_in_parts(name, num_rays, *values, structs(outputs), folder=folder)
    return RayOutputs(*outputs)


def march_on_cpu(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> MergedSamples:
    num_rays, room = len(rays.origins), options.most_kept(layout.most_samples)
    samples = structs(empty_samples(num_rays * room, index=torch.int32))
    starts, kept, num_intersected = torch.empty(3, num_rays, dtype=torch.int64)
    fully_covered, (skipped, dropped) = torch.empty(num_rays, 1, dtype=torch.bool), torch.empty(2, num_rays, 1)
    walk = (layout.cpu_scene(tables), structs(dense_fields(rays)))
    how = (float(options.threshold), float(options.fair_share), options.blends)
    outputs = (starts, kept, num_intersected, fully_covered, skipped, dropped, samples)
    call_in_parts("mmpi_march", num_rays, *walk, room, *how, *outputs)
    width = max(1, int(kept.max())) if num_rays else 1
    slots = [*empty_samples(num_rays, width), torch.empty(num_rays, width, dtype=torch.bool)]
    call_in_parts("mmpi_pack", num_rays, starts, kept, width, samples, structs(slots))
    return MergedSamples(
        *slots,
        skipped_total=skipped,
        dropped_mass=dropped,
        num_intersected=num_intersected,
        fully_covered=fully_covered,
    )


def render_fused_on_cpu(
    layout: SceneLayout, tables: Tables, features: Tensor, rays: Rays, options: MarchOptions
) -> RayOutputs:
    if "tiles" not in layout.packed:
        # Rays skip tiles from which nothing stored can be read: where the lower corner of four texels lies in any other
        # tile, one of the four is stored.
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
    return ray_outputs("mmpi_render", len(rays.origins), features.shape[1], *walk, *texels, *how)
