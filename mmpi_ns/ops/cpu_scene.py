"""A scene in the layout of the compiled functions: the structures of ``cpp/scene.h``."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from mmpi_ns.ops.build import address, arguments
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.scene.texels import TexelGrid


class Grid(ctypes.Structure):
    """A head's texels, which must outlive it."""

    _fields_ = [
        *((n, ctypes.c_int64) for n in ("depth", "height", "width", "down", "across", "first_tile")),
        ("tiles", ctypes.c_void_p),
        ("bias", ctypes.c_int64),
    ]

    @staticmethod
    def of(grid: TexelGrid, bias: int = 0) -> Grid:
        numbers = (grid.depth, grid.height, grid.width, grid.down, grid.across, grid.first_tile)
        return Grid(*numbers, address(grid.tiles, torch.int32), bias)


class Layer(ctypes.Structure):
    """Of a small network (``cpp/layers.h``)."""

    _fields_ = [(n, ctypes.c_int64) for n in ("outputs", "inputs")] + [
        (n, ctypes.c_void_p) for n in ("weights", "biases")
    ]

    @staticmethod
    def array(pairs: Sequence[tuple[Tensor, Tensor]]) -> ctypes.Array:
        """Weights and biases, which must outlive it."""
        return (Layer * len(pairs))(*(Layer(*w.shape, *arguments((w, b))) for w, b in pairs))


class SceneTables(ctypes.Structure):
    """A plan and its tables."""

    _fields_ = [(n, ctypes.c_int64) for n in ("num_mpis", "num_heads")] + [
        (n, ctypes.c_void_p) for n in ("mpis", "grids", "biases", "cube", "density", "reliability", "touched")
    ]


class CpuScene:
    """A layout as structures, which live as long as this does; made once by ``CpuScene.of``."""

    def __init__(self, layout: SceneLayout) -> None:
        self.mpis, self.cube, count = layout.head_rows(), layout.cube_row(), layout.num_heads
        self.grids = (Grid * count)(*map(Grid.of, layout.grids, layout.bias_starts()))
        self.biases = torch.cat(layout.biases).float().contiguous()

    @staticmethod
    def of(layout: SceneLayout) -> CpuScene:
        return layout.once("cpu", CpuScene)

    def with_tables(self, tables: Tables) -> SceneTables:
        """Argument of a compiled function; the tables must outlive it."""
        plan = (*arguments([self.mpis]), ctypes.addressof(self.grids), *arguments([self.biases, self.cube]))
        assert tables.density.dtype == tables.reliability.dtype == torch.float32 and tables.touched.dtype == torch.uint8
        return SceneTables(len(self.mpis), len(self.grids), *plan, *arguments(tables))
