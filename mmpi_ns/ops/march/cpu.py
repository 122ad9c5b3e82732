"""The march, compiled: ``march.cpp`` to train and ``show.cpp`` for pictures."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import call_in_parts, structs
from mmpi_ns.ops.cpu_scene import scene_of
from mmpi_ns.ops.layout import SceneLayout, Tables, dense
from mmpi_ns.ops.march.rays import MarchOptions, MergedSamples, Rays, Shown
from mmpi_ns.scene.baked import columns_from

_FLAT = (torch.int32, torch.int32, *[torch.float32] * 4)
_SLOTS = (torch.int64, torch.int64, *[torch.float32] * 4, torch.bool)


def shown(name: str, num_rays: int, channels: int, *values: Any) -> Shown:
    """What a compiled function of ``(begin, end, *values, outputs)`` shows."""
    outputs = [torch.empty(num_rays, n) for n in (channels, 1, 1, 1, 1, 1, 1)]
    call_in_parts(name, num_rays, *values, structs(outputs))
    return Shown(*outputs)


def march(layout: SceneLayout, tables: Tables, rays: Rays, options: MarchOptions) -> MergedSamples:
    num_rays, room = len(rays.origins), options.most_kept(layout.most_samples)
    flat = [torch.empty((num_rays * room, 3) if i == 2 else num_rays * room, dtype=t) for i, t in enumerate(_FLAT)]
    starts, kept, live = torch.empty(3, num_rays, dtype=torch.int64)
    explained, (skipped, dropped) = torch.empty(num_rays, 1, dtype=torch.bool), torch.empty(2, num_rays, 1)
    walk = (scene_of(layout, tables), structs(rays.dense()))
    how = (float(options.threshold), float(options.fair_share), options.blends)
    call_in_parts("mmpi_march", num_rays, *walk, room, *how, starts, kept, live, explained, skipped, dropped, *flat)
    shape = (num_rays, max(1, int(kept.max())) if num_rays else 1)
    slots = [torch.empty((*shape, 3) if i == 2 else shape, dtype=t) for i, t in enumerate(_SLOTS)]
    call_in_parts("mmpi_pack", num_rays, starts, kept, shape[1], *flat, *slots)
    return MergedSamples(*slots, skipped_total=skipped, dropped_mass=dropped, live=live, explained=explained)


def _tiles(layout: SceneLayout) -> ctypes.Array:
    """The tiles of all MPIs from which something can be read, so that rays pass over the others: where the lower corner
    of four texels is in the tile, one of them is stored."""
    columns, bricks, count = [torch.zeros(0, 2, dtype=torch.int32)], [torch.zeros(1, 4, dtype=torch.int32)], 0
    for grid in layout.grids[: len(layout.mpis)]:
        tiles = pad(grid.own_tiles, (0, 1, 0, 1))
        down, across = ((n - 2) // 8 + 1 for n in (grid.height, grid.width))  # of lower corners
        corners = torch.stack([tiles[:, y : y + down, x : x + across] for y in (0, 1) for x in (0, 1)], -1)
        stored, places = columns_from((corners > 0).any(-1), count)
        columns.append(stored)
        bricks.append(corners[tuple(places.T)])
        count += len(places)
    return structs((torch.cat(columns), torch.cat(bricks[1:] + bricks[:1])))


def show_rays(layout: SceneLayout, tables: Tables, features: Tensor, rays: Rays, options: MarchOptions) -> Shown:
    walk = (scene_of(layout, tables), structs(rays.dense()))
    texels = (layout.once("tiles", _tiles), *dense(features), *features.shape)
    how = (float(options.threshold), float(options.fair_share), options.blends)
    return shown("mmpi_show", len(rays.origins), features.shape[1], *walk, *texels, *how)
