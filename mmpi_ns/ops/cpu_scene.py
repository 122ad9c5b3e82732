"""A scene in the layout of the compiled functions: the structs of ``cpp/scene.h``."""

from __future__ import annotations

import ctypes
from typing import Any

import torch

from mmpi_ns.ops.build import structs
from mmpi_ns.ops.layout import SceneLayout, Tables, frame_rows, shaped


def grids_of(layout: SceneLayout) -> ctypes.Array:
    """The texels of all heads: an array of ``Grid``."""
    return layout.once("cpu", _pack)[2]


def scene_of(layout: SceneLayout, tables: Tables) -> ctypes.Array:
    """A ``Scene`` of a layout and its tables."""
    sizes = (len(layout.mpis), layout.num_heads, float(layout.content_near))
    return structs((*sizes, *layout.once("cpu", _pack), *tables.dense()))


def _pack(layout: SceneLayout) -> tuple[Any, ...]:
    """Numbers of the MPIs, frames, grids, biases and the cube."""
    count, planes, grids = len(layout.mpis), sum(m.planes for m in layout.mpis), []
    for grid, bias in zip(layout.grids, layout.bias_starts(), strict=True):
        assert grid.tiles.dtype == torch.int32
        sizes = (grid.depth, grid.height, grid.width, grid.down, grid.across, grid.first_tile)
        grids.append((*sizes, grid.tiles, bias))
    mpis, frames = shaped(layout.head_rows, count, 9), shaped(frame_rows(layout.frames), count, 19)
    biases = shaped(torch.cat(layout.biases).float(), planes)
    return mpis, frames, structs(*grids), biases, shaped(layout.cube_row, 12)
