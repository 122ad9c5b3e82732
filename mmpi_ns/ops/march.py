"""All heads of a ray at once, front to back, to the samples that matter: the sampler's inner loop, compiled.

The reference is ``mmpi_sampler.march_reference``. The kernel looks up every head's live samples a block at a time,
takes the nearest at each step, and ends a ray where less than 1e-5 of its light is left (and less than a sample must
weigh to be kept), so a ray costs what lies in front of its first surfaces.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops import native
from mmpi_ns.ops.compositing import BlendForm
from mmpi_ns.scene.geometry import Cube, PlaneHits
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.scene.texels import TexelGrid

FORMS: dict[BlendForm | None, int] = {None: 0, "paper": 1, "opacity": 2}
"""How the kernels are told in which form reliability enters; ``BAKED`` more where shares stand in its place."""
BAKED = 2
_SAMPLE_TYPES = (torch.int32, torch.int32, *[torch.float32] * 4)


@dataclass(frozen=True)
class Kept:
    """The samples of R rays that matter, nearest first in S slots a ray, and what the dropped ones leave behind."""

    heads: Int[Tensor, "R S"]
    planes: Int[Tensor, "R S"]
    ndc: Float[Tensor, "R S 3"]
    inverse_t: Float[Tensor, "R S"]
    """0 in empty slots."""
    tau: Float[Tensor, "R S"]
    """Optical depth, blended where reliability takes part."""
    skipped_before: Float[Tensor, "R S"]
    """Optical depth of the dropped samples in front of each sample."""
    valid: Bool[Tensor, "R S"]
    skipped_total: Float[Tensor, "R 1"]
    dropped_mass: Float[Tensor, "R 1"]
    """Sum of the weights of the dropped samples."""


class _Mpi(ctypes.Structure):
    _fields_ = [
        (n, ctypes.c_float) for n in ("step", "end", "share", "s_scale", "u0", "u_scale", "v0", "v_scale", "interval")
    ]


class Grid(ctypes.Structure):
    """A head's texels. The tiles must outlive it."""

    _fields_ = [
        *((n, ctypes.c_int64) for n in ("depth", "height", "width", "down", "across", "first_tile")),
        ("tiles", ctypes.c_void_p),
        ("bias", ctypes.c_int64),
    ]

    @staticmethod
    def of(grid: TexelGrid, bias: int = 0) -> Grid:
        sizes = (grid.depth, grid.height, grid.width, grid.down, grid.across, grid.first_tile)
        return Grid(*sizes, native.address(grid.tiles, torch.int32), bias)


class _Cube(ctypes.Structure):
    _fields_ = [
        ("lower", ctypes.c_float * 3),
        ("extent", ctypes.c_float * 3),
        *((n, ctypes.c_float) for n in ("step", "bias", "interval")),
    ]


class SceneTables(ctypes.Structure):
    """A plan and its tables, as the kernels take them."""

    _fields_ = [(n, ctypes.c_int64) for n in ("num_mpis", "num_heads")] + [
        (n, ctypes.c_void_p) for n in ("mpis", "grids", "biases", "cube", "density", "reliability", "touched")
    ]


class _Rays(ctypes.Structure):
    _fields_ = [
        (n, ctypes.c_void_p)
        for n in ("origins", "directions", "local_origins", "local_directions", "u", "v", "first", "counts")
    ]


class MarchScene:
    """A plan's constants as the kernel reads them (``cpp/scene.h``).

    Args:
        mpis: the MPIs, at the resolution in use.
        grids: texels of all heads.
        steps: disparity between the planes of each MPI.
        biases: of each MPI's planes.
        depth_scale: factor on every optical depth of an MPI.
        cube: the cube, with the bias and the interval of its samples, or None.
    """

    def __init__(
        self,
        mpis: tuple[MPIPlan, ...],
        grids: list[TexelGrid],
        steps: Float[Tensor, "K"],
        biases: list[Float[Tensor, "L"]],
        depth_scale: float,
        cube: tuple[Cube, float, float] | None,
    ) -> None:
        starts = [sum(len(b) for b in biases[:k]) for k in range(len(grids))]
        self._mpis = (_Mpi * len(mpis))(*(_mpi(m, float(s), depth_scale) for m, s in zip(mpis, steps, strict=True)))
        self._grids = (Grid * len(grids))(*(Grid.of(g, b) for g, b in zip(grids, starts, strict=True)))
        self._tiles = [g.tiles for g in grids]  # alive as long as the kernel may read them
        self._biases = torch.cat(biases).float().contiguous()
        self._cube = None if cube is None else _cube(*cube)
        self.num_mpis, self.num_heads = len(mpis), len(grids)

    def with_tables(self, density: Tensor, reliability: Tensor, touched: Tensor) -> SceneTables:
        """What the kernel takes; the tables must outlive it."""
        return SceneTables(
            self.num_mpis,
            self.num_heads,
            ctypes.addressof(self._mpis),
            ctypes.addressof(self._grids),
            self._biases.data_ptr(),
            ctypes.addressof(self._cube) if self._cube is not None else None,
            native.address(density),
            native.address(reliability),
            native.address(touched, torch.uint8),
        )


def _mpi(mpi: MPIPlan, step: float, depth_scale: float) -> _Mpi:
    u0, u1, v0, v1 = mpi.extent
    depth = (step, mpi.last_disparity, mpi.depth_share, 2 * mpi.near / mpi.depth_share)
    return _Mpi(*depth, u0, 2 / (u1 - u0), v0, 2 / (v1 - v0), 256.0 / mpi.planes * depth_scale)


def _cube(cube: Cube, bias: float, interval: float) -> _Cube:
    vector = ctypes.c_float * 3
    return _Cube(vector(*cube.lower.tolist()), vector(*(cube.upper - cube.lower).tolist()), cube.step, bias, interval)


def march(
    lib: ctypes.CDLL,
    scene: SceneTables,
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    hits: PlaneHits,
    first: Int[Tensor, "R H"],
    counts: Int[Tensor, "R H"],
    threshold: float,
    fair_share: float,
    form: BlendForm | None,
    baked: bool = False,
) -> Kept:
    """The samples of each ray that matter.

    Args:
        lib: the compiled kernels.
        scene: the plan with its tables.
        origins: ray origins, world axes.
        directions: unit ray directions.
        hits: where the rays cross the planes.
        first: m of each head's nearest live plane; the cube's first sample in the last column, where there is a cube.
        counts: live samples of each head.
        threshold: weight below which a sample is dropped; 0 keeps all and ends no ray early.
        fair_share: bound on the threshold relative to equal weights (``merge.keep_survivors``).
        form: how reliability enters; None for not at all.
        baked: the scene's reliability holds shares (``baking.bake_shares``).
    """
    parts = (origins, directions, hits.local_origins, hits.local_directions, hits.u, hits.v)
    held: list[Tensor] = [x.contiguous() for x in (*parts, first, counts)]  # alive until the kernel has run
    rays = _Rays(*(native.address(x, x.dtype) for x in held))
    total = counts.sum(-1)
    starts = total.cumsum(0) - total
    num_rays, size = len(total), int(total.sum())
    flat = [torch.empty((size, 3) if i == 2 else size, dtype=t) for i, t in enumerate(_SAMPLE_TYPES)]
    kept = torch.empty(num_rays, dtype=torch.int64)
    left = torch.empty(2, num_rays, 1)
    ends = [native.address(kept, torch.int64), native.address(left[0]), native.address(left[1])]
    places = [native.address(x, x.dtype) for x in flat]

    def march_part(begin: int, end: int) -> None:
        lib.mmpi_march(
            ctypes.byref(scene),
            ctypes.byref(rays),
            native.address(starts, torch.int64),
            ctypes.c_int64(begin),
            ctypes.c_int64(end),
            ctypes.c_float(threshold),
            ctypes.c_float(fair_share),
            FORMS[form] + BAKED * baked,
            *ends,
            *places,
        )

    native.in_parts(march_part, num_rays)
    return Kept(*_pack(lib, starts, kept, places), skipped_total=left[0], dropped_mass=left[1])


def _pack(lib: ctypes.CDLL, starts: Tensor, kept: Tensor, places: list[Any]) -> list[Tensor]:
    """Flat samples in slots, packed to the left."""
    num_rays, width = len(kept), max(1, int(kept.max())) if kept.numel() else 1
    types = (torch.int64, torch.int64, *[torch.float32] * 4, torch.bool)
    slots = [torch.empty((num_rays, width, 3) if i == 2 else (num_rays, width), dtype=t) for i, t in enumerate(types)]
    pointers = [native.address(x, x.dtype) for x in slots]

    def pack_part(begin: int, end: int) -> None:
        lib.mmpi_pack(
            native.address(starts, torch.int64),
            native.address(kept, torch.int64),
            *map(ctypes.c_int64, (begin, end, width)),
            *places,
            *pointers,
        )

    native.in_parts(pack_part, num_rays)
    return slots
