"""A scene as the compiled functions read it: the structures of ``cpp/scene.h``."""

from __future__ import annotations

import ctypes

import torch

from mmpi_ns.ops.build import address
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.scene.texels import TexelGrid


class _Mpi(ctypes.Structure):
    _fields_ = [
        (n, ctypes.c_float) for n in ("step", "end", "share", "s_scale", "u0", "u_scale", "v0", "v_scale", "interval")
    ]


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


class _Cube(ctypes.Structure):
    _fields_ = [
        ("lower", ctypes.c_float * 3),
        ("extent", ctypes.c_float * 3),
        *((n, ctypes.c_float) for n in ("step", "bias", "interval")),
    ]


class SceneTables(ctypes.Structure):
    """A plan and its tables."""

    _fields_ = [(n, ctypes.c_int64) for n in ("num_mpis", "num_heads")] + [
        (n, ctypes.c_void_p) for n in ("mpis", "grids", "biases", "cube", "density", "reliability", "touched")
    ]


class CpuScene:
    """A layout as structures, which live as long as this does; made once by ``CpuScene.of``."""

    def __init__(self, layout: SceneLayout) -> None:
        mpis, grids, cube = layout.mpis, layout.grids, layout.cube
        steps = layout.frames.disparity_steps
        rows = (_mpi(m, float(s), layout.interval(k)) for k, (m, s) in enumerate(zip(mpis, steps, strict=True)))
        starts = [sum(len(b) for b in layout.biases[:k]) for k in range(len(grids))]
        self.mpis = (_Mpi * len(mpis))(*rows)
        self.grids = (Grid * len(grids))(*(Grid.of(g, b) for g, b in zip(grids, starts, strict=True)))
        self.biases = torch.cat(layout.biases).float().contiguous()
        self.cube: _Cube | None = None
        if cube is not None:
            vector, extent = ctypes.c_float * 3, (cube.upper - cube.lower).tolist()
            numbers = (cube.step, layout.cube_bias, layout.cube_interval)
            self.cube = _Cube(vector(*cube.lower.tolist()), vector(*extent), *numbers)

    @staticmethod
    def of(layout: SceneLayout) -> CpuScene:
        return layout.once("cpu", CpuScene)

    def with_tables(self, tables: Tables) -> SceneTables:
        """What a compiled function takes; the tables must outlive it."""
        return SceneTables(
            len(self.mpis),
            len(self.grids),
            ctypes.addressof(self.mpis),
            ctypes.addressof(self.grids),
            self.biases.data_ptr(),
            ctypes.addressof(self.cube) if self.cube is not None else None,
            address(tables.density),
            address(tables.reliability),
            address(tables.touched, torch.uint8),
        )


def _mpi(mpi: MPIPlan, step: float, interval: float) -> _Mpi:
    u0, u1, v0, v1 = mpi.extent
    depth = (step, mpi.last_disparity, mpi.depth_share, 2 * mpi.near / mpi.depth_share)
    return _Mpi(*depth, u0, 2 / (u1 - u0), v0, 2 / (v1 - v0), interval)
