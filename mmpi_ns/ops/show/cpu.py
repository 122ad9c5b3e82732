"""What rays show, compiled: ``show.cpp``."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from mmpi_ns.ops.build import arguments, call_in_parts
from mmpi_ns.ops.cpu_scene import CpuScene
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march.cpu import Rays, how
from mmpi_ns.ops.march.reference import Crossings, MarchOptions
from mmpi_ns.ops.show.reference import Shown
from mmpi_ns.scene.baked import columns_from


class _Tiles(ctypes.Structure):
    _fields_ = [(n, ctypes.c_void_p) for n in ("columns", "bricks")]


class _Outputs(ctypes.Structure):
    _fields_ = [
        (n, ctypes.c_void_p)
        for n in ("gathered", "mass", "transmittance", "accumulation", "inverse_t", "winner", "dropped")
    ]


class _Columns:
    """The tiles of all MPIs from which something can be read, so that rays pass over the others: where the lower corner
    of four texels is in the tile, one of them is stored."""

    def __init__(self, layout: SceneLayout) -> None:
        columns, bricks, count = [torch.zeros(0, 2, dtype=torch.int32)], [torch.zeros(1, 4, dtype=torch.int32)], 0
        for grid in layout.grids[: len(layout.mpis)]:
            own = torch.nn.functional.pad(grid.own_tiles, (0, 1, 0, 1))
            down, across = ((n - 2) // 8 + 1 for n in (grid.height, grid.width))  # of lower corners
            corners = torch.stack([own[:, y : y + down, x : x + across] for y in (0, 1) for x in (0, 1)], -1)
            found, places = columns_from((corners > 0).any(-1), count)
            columns.append(found)
            bricks.append(corners[tuple(places.T)])
            count += len(places)
        self.columns, self.bricks = torch.cat(columns), torch.cat(bricks[1:] + bricks[:1])
        self.tiles = _Tiles(*arguments([self.columns, self.bricks]))


def show_rays(layout: SceneLayout, tables: Tables, features: Tensor, rays: Crossings, options: MarchOptions) -> Shown:
    """See ``ops.show``."""
    scene, packed = CpuScene.of(layout).with_tables(tables), Rays.of(rays)
    features, num_rays = features.contiguous(), len(rays.origins)
    outputs = [torch.empty(num_rays, n) for n in (features.shape[1], 1, 1, 1, 1, 1, 1)]
    known = layout.once("columns", _Columns)
    given = (ctypes.byref(scene), ctypes.byref(packed), ctypes.byref(known.tiles), features, *features.shape)
    call_in_parts("mmpi_show", num_rays, (*given, *how(options)), (ctypes.byref(_Outputs(*arguments(outputs))),))
    return Shown(*outputs)
