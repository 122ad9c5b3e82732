"""Scene data of the operations: MPIs and cube, texels, raw density to optical depth."""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, get_args, get_type_hints

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from mmpi_ns.ops.build import structs
from mmpi_ns.scene.geometry import Cube, Frames
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.scene.texels import TexelGrid


class Tables(NamedTuple):
    """The pooled tables of T rows that rays are marched through."""

    density: Float[Tensor, "T 1"]
    """Raw densities."""
    reliability: Float[Tensor, "T 1"]
    touched: UInt8[Tensor, "T"]
    """1 where a training ray read the row."""


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """Constants of K MPIs, and of the cube if there is one (H heads, the cube last), at the resolution in use."""

    mpis: tuple[MPIPlan, ...]
    frames: Frames
    grids: list[TexelGrid]
    """Texels of all heads."""
    biases: list[Float[Tensor, "L"]]
    """Biases of the raw densities of each MPI's planes."""
    depth_scale: float = 1.0
    """Factor on every optical depth of an MPI."""
    cube: Cube | None = None
    cube_bias: float = 0.0
    cube_interval: float = 1.0
    content_near: float = 0.0
    """Distance to the first content."""
    packed: dict[str, Any] = field(default_factory=dict)
    """The same in the layout of the compiled operations, which create it once. If threads do so at the same time, the
    first one's stays (``setdefault``), because compiled operations hold addresses in it."""

    @property
    def num_heads(self) -> int:
        return len(self.grids)

    @cached_property
    def most_samples(self) -> int:
        """Maximum samples of a ray: planes of all MPIs, and the cube's diagonal in steps."""
        cube, planes = self.cube, sum(m.planes for m in self.mpis)
        if cube is None:
            return planes
        return planes + int(2 * math.hypot(*(cube.upper - cube.lower).tolist()) / cube.step) + 2

    @cached_property
    def constants(self) -> tuple[Float[Tensor, "K 26"], Float[Tensor, "P"], Float[Tensor, "12"]]:
        """Constants of the heads for compiled code.

        Of each MPI: ``frame_rows``, 1 - near / far, scale of NDC s, lower end and scale of u and of v, interval. Biases
        of all planes of all MPIs. Lower corner of the cube, extent, step between samples, bias, interval, upper corner;
        zeros without a cube.
        """
        rows, cube, cube_row, device = [], self.cube, [0.0] * 12, self.frames.origins.device
        for k, mpi in enumerate(self.mpis):
            u0, u1, v0, v1 = mpi.extent
            depth = (mpi.depth_share, 2 * mpi.near / mpi.depth_share)
            rows.append((*depth, u0, 2 / (u1 - u0), v0, 2 / (v1 - v0), self.interval(k)))
        numbers = torch.tensor(rows, dtype=torch.float32, device=device).reshape(len(rows), 7)
        if cube is not None:
            corner, extent = cube.lower.tolist(), (cube.upper - cube.lower).tolist()
            cube_row = [*corner, *extent, cube.step, self.cube_bias, self.cube_interval, *cube.upper.tolist()]
        biases = torch.cat(self.biases).to(device, torch.float32)
        return torch.cat([frame_rows(self.frames), numbers], -1), biases, torch.tensor(cube_row, device=device)

    @cached_property
    def cpu_grids(self) -> ctypes.Array:
        """Texels of all heads for C++: ``Grid`` of ``cpp/scene.h``."""
        assert self.grids[0].tiles.dtype == torch.int32
        sizes = [(g.depth, g.height, g.width, g.down, g.across, g.first_tile, g.tiles) for g in self.grids]
        return structs(*((*each, bias) for each, bias in zip(sizes, self.bias_starts(), strict=True)))

    def cpu_scene(self, tables: Tables) -> ctypes.Array:
        """The layout and its tables for C++: a ``Scene`` of ``cpp/scene.h``."""
        sizes = (len(self.mpis), self.num_heads, float(self.content_near))
        head_rows, biases, cube_row = self.constants
        return structs((*sizes, head_rows, self.cpu_grids, biases, cube_row, *dense_fields(tables)))

    def bias_starts(self) -> list[int]:
        """Index of each head's first plane in the biases of ``constants``."""
        return [sum(len(b) for b in self.biases[:k]) for k in range(self.num_heads)]

    def interval(self, k: int) -> float:
        """Factor on head k's softplus: the interval that a sample represents."""
        return self.cube_interval if k >= len(self.mpis) else 256.0 / self.mpis[k].planes * self.depth_scale

    @cached_property
    def depth_constants(self) -> tuple[int, Float[Tensor, "H*L"], Float[Tensor, "H"], Float[Tensor, "H"]]:
        """Most planes of a head; biases of so many planes of each, and its interval in float32 and float64; the cube
        has one bias."""
        device, in_cube = self.frames.origins.device, [] if self.cube is None else [torch.tensor([self.cube_bias])]
        rows = [x.to(device) for x in (*self.biases, *in_cube)]
        biases = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=self.cube_bias)
        intervals = [self.interval(k) for k in range(self.num_heads)]
        exact = torch.tensor(intervals, dtype=torch.float64, device=device)
        return biases.shape[1], biases.flatten(), exact.float(), exact

    def optical_depth(
        self, heads: Int[Tensor, "N"] | int, raw: Float[Tensor, "N"], planes: Int[Tensor, "N"]
    ) -> Float[Tensor, "N"]:
        """tau from raw densities: softplus(raw + bias) times the interval, in float32 or wider."""
        raw = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
        most, biases, *intervals = self.depth_constants
        heads = torch.full_like(planes, heads) if isinstance(heads, int) else heads
        planes = planes.clamp(max=most - 1)  # any, of the same ones, in the cube
        bias = biases.index_select(0, torch.add(planes, heads, alpha=most))
        interval = intervals[raw.dtype == torch.float64].index_select(0, heads)
        return torch.nn.functional.softplus(raw + bias) * interval


def frame_rows(frames: Frames) -> Float[Tensor, "K 19"]:
    """Of each MPI: origin, axes, extent, disparity between planes and of the last one, number of the first one."""
    columns = (frames.disparity_steps, frames.last_disparities, frames.num_planes - 1)
    parts = (frames.origins, frames.axes.flatten(1), frames.extents, *(x[:, None] for x in columns))
    return torch.cat([x.float() for x in parts], -1)


def dense(*tensors: Tensor | None, dtype: torch.dtype = torch.float32) -> list[Any]:
    """Contiguous tensors of this type, for compiled code, which checks nothing itself; None for None."""
    assert all(x is None or x.dtype == dtype for x in tensors), f"not all are {dtype}, which is read"
    return [x if x is None else x.contiguous() for x in tensors]


def dense_fields(values: Any) -> list[Any]:
    """``dense`` for the tensors of a named tuple, each of its annotated type."""
    forms = annotated(type(values))
    return [x for name, value in values._asdict().items() for x in dense(value, dtype=forms[name][1])]


@functools.cache
def annotated(owner: Callable[..., Any]) -> dict[str, tuple[tuple[str | int, ...], torch.dtype]]:
    """Sizes of the tensors of an owner by name, and their types in compiled code; without those of any shape."""
    forms = {}
    for name, hint in get_type_hints(owner).items():
        arrays = [part for part in (hint, *get_args(hint)) if isinstance(getattr(part, "dim_str", None), str)]
        if arrays and "..." not in arrays[0].dim_str:
            # Of a kind of numbers the usual type, else the only one.
            kind = next((x for x in ("float32", "int64") if x in arrays[0].dtypes), arrays[0].dtypes[0])
            sizes = tuple(int(x) if x.isdigit() else x for x in arrays[0].dim_str.split())
            forms[name] = sizes, getattr(torch, kind)
    return forms
