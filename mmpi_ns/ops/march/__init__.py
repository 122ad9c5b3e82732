"""Compiled forms of sampling and merging (``mmpi_ns/sampler.py`` defines both in torch): C++ here, Triton in ``gpu``.

Each step takes the nearest of all heads' next samples. A ray terminates where its transmittance falls below 1e-5 (and
below the weight of a kept sample), so its cost is that of the samples in front of its first surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import OPS, call_in_parts, even_bounds, structs
from mmpi_ns.ops.composite import ray_numbers
from mmpi_ns.ops.layout import SceneLayout, Tables, dense, dense_fields
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

    samples: int
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
    """The kept samples of R rays, ray behind ray and nearest first, and the attenuation by the pruned ones."""

    heads: Int[Tensor, "N"]
    """With a capacity, 0 behind the last ray, like all fields."""
    planes: Int[Tensor, "N"]
    ndc: Float[Tensor, "N 3"]
    inverse_t: Float[Tensor, "N"]
    tau: Float[Tensor, "N"]
    """Optical depth, blended if reliability is used."""
    skipped_before: Float[Tensor, "N"]
    """Optical depth of the dropped samples in front of each sample."""
    starts: Int[Tensor, "R+1"]
    """Samples of ray r are ``starts[r]:starts[r + 1]``."""
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
    """Number of kept samples, of all heads and of each, also of those beyond the capacity; only with one."""

    @cached_property
    def rays(self) -> Int[Tensor, "N"]:
        """Ray of each sample; the last one for those behind it."""
        return ray_numbers(self.starts, len(self.heads)).clamp(max=max(0, len(self.starts) - 2))

    def by_head(self, num_heads: int, chosen: Bool[Tensor, "R"] | None = None) -> list[Int[Tensor, "n"]]:
        """Indices of each head's samples on the chosen rays. If their numbers are known, those of all rays, and N where
        there are fewer, without synchronisation."""
        count = len(self.heads)
        if self.head_counts is None:
            asked = self.heads if chosen is None else torch.where(chosen[self.rays], self.heads, -1)
            return [(asked == k).nonzero()[:, 0] for k in range(num_heads)]
        index = torch.arange(count, device=self.heads.device)
        heads, order = torch.where(index < self.starts[-1], self.heads, num_heads).sort(stable=True)
        first, parts = torch.searchsorted(heads, torch.arange(num_heads + 1, device=heads.device)), []
        for k, number in enumerate(self.head_counts):
            at = first[k] + torch.arange(number, device=heads.device)
            parts.append(torch.where(at < first[k + 1], order[at.clamp(max=count - 1)], count))
        return parts


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
    samples, bounds = empty_samples(num_rays * room), even_bounds(num_rays)
    kept, num_intersected = torch.empty(2, num_rays, dtype=torch.int64)
    fully_covered, (skipped, dropped) = torch.empty(num_rays, 1, dtype=torch.bool), torch.empty(2, num_rays, 1)
    walk = (layout.cpu_scene(tables), structs(dense_fields(rays)))
    how = (float(options.threshold), float(options.fair_share), options.blends)
    outputs = (kept, num_intersected, fully_covered, skipped, dropped, structs(samples))
    call_in_parts("mmpi_march", bounds, *walk, room, *how, *outputs)
    starts = pad(kept.cumsum(0), (1, 0))
    # Each part has left its samples in one piece.
    firsts, counts = [room * first for first in bounds[:-1]], starts[bounds].diff().tolist()
    pieces = [[x[i : i + n] for i, n in zip(firsts, counts, strict=True)] for x in samples]
    return MergedSamples(
        *(torch.cat(each) if len(each) > 1 else each[0] for each in pieces),
        starts=starts,
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
