"""A scene in the layout of the compiled functions: the structures of ``cpp/scene.h``."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor
from typing_extensions import Self

from mmpi_ns.ops.build import arguments
from mmpi_ns.ops.layout import SceneLayout, Tables, frame_rows, shaped
from mmpi_ns.scene.texels import TexelGrid


def addresses(*names: str) -> list[tuple[str, type]]:
    """Fields of a structure of pointers."""
    return [(name, ctypes.c_void_p) for name in names]


class Grid(ctypes.Structure):
    """A head's texels, which must outlive it."""

    _fields_ = [
        *((n, ctypes.c_int64) for n in ("depth", "height", "width", "down", "across", "first_tile")),
        ("tiles", ctypes.c_void_p),
        ("bias", ctypes.c_int64),
    ]

    @staticmethod
    def of(grid: TexelGrid, bias: int) -> Grid:
        numbers = (grid.depth, grid.height, grid.width, grid.down, grid.across, grid.first_tile)
        assert grid.tiles.dtype == torch.int32
        return Grid(*numbers, *arguments((grid.tiles, bias)))


class Layer(ctypes.Structure):
    """Of a small network (``cpp/layers.h``)."""

    _fields_ = [*((n, ctypes.c_int64) for n in ("outputs", "inputs")), *addresses("weights", "biases")]

    @staticmethod
    def array(pairs: Sequence[tuple[Tensor, Tensor]]) -> ctypes.Array:
        """Weights and biases, which must outlive it."""
        return (Layer * len(pairs))(*(Layer(*w.shape, *arguments((w, b))) for w, b in pairs))


class Pointers(ctypes.Structure):
    """Addresses of tensors, which live as long as it does; null for None."""

    held: tuple[Tensor | None, ...]

    @classmethod
    def to(cls, *tensors: Tensor | None) -> Self:
        pointers = cls(*arguments(tensors))
        pointers.held = tensors
        return pointers


class SceneTables(ctypes.Structure):
    """A plan and its tables."""

    _fields_ = [
        *((n, ctypes.c_int64) for n in ("num_mpis", "num_heads")),
        ("content_near", ctypes.c_float),
        *addresses("mpis", "frames", "grids", "biases", "cube", "density", "reliability", "touched"),
    ]
    held: Tables


class CpuScene:
    """A layout as structures, which live as long as this does; made once by ``CpuScene.of``."""

    def __init__(self, layout: SceneLayout) -> None:
        count, planes = layout.num_heads, [m.planes for m in layout.mpis]
        self.layout = layout
        self.mpis, self.cube = shaped(layout.head_rows, len(planes), 9), shaped(layout.cube_row, 12)
        self.grids = (Grid * count)(*map(Grid.of, layout.grids, layout.bias_starts()))
        self.biases = shaped(torch.cat(layout.biases).float(), sum(planes))
        self.frames = shaped(frame_rows(layout.frames), len(planes), 19)

    @staticmethod
    def of(layout: SceneLayout) -> CpuScene:
        return layout.once("cpu", CpuScene)

    def with_tables(self, tables: Tables) -> SceneTables:
        """Argument of a compiled function; this must outlive it."""
        held, grids = tables.of_rows(self.layout.num_rows), ctypes.addressof(self.grids)
        plan = (*arguments([self.mpis, self.frames]), grids, *arguments([self.biases, self.cube]))
        scene = SceneTables(len(self.mpis), len(self.grids), self.layout.content_near, *plan, *arguments(held))
        scene.held = held
        return scene
