"""Compiled forms of sampling and merging (``mmpi_ns/sampler.py`` defines both in torch): C++ here, Triton in ``gpu``.

They take the nearest of all heads' next samples at each step, and end a ray where less than 1e-5 of its transmittance
is left (and less than a sample must weigh to be kept), so a ray costs what lies in front of its first surfaces.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import OPS, call_in_parts, structs
from mmpi_ns.ops.layout import SceneLayout, Tables, dense, dense_fields
from mmpi_ns.ops.march.rays import Capacity as Capacity
from mmpi_ns.ops.march.rays import MarchOptions as MarchOptions
from mmpi_ns.ops.march.rays import MergedSamples as MergedSamples
from mmpi_ns.ops.march.rays import Rays as Rays
from mmpi_ns.ops.march.rays import Shown, empty_samples
from mmpi_ns.scene.columns import columns_from


def shown(name: str, num_rays: int, channels: int, *values: Any, folder: Path = OPS) -> Shown:
    """What a compiled function of ``(begin, end, *values, outputs)`` shows (see ``build.call_in_parts``)."""
    outputs = [torch.empty(num_rays, n) for n in (channels, 1, 1, 1, 1, 1, 1)]
    call_in_parts(name, num_rays, *values, structs(outputs), folder=folder)
    return Shown(*outputs)


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
