"""Scene data of the operations: MPIs and cube, layout of texels, and raw density to optical depth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from mmpi_ns.scene.geometry import Cube, Frames
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.scene.texels import BRICK, TexelGrid


class Tables(NamedTuple):
    """The pooled tables that a ray is marched through, of T rows."""

    density: Float[Tensor, "T 1"]
    """Raw densities."""
    reliability: Float[Tensor, "T 1"]
    touched: UInt8[Tensor, "T"]
    """1 where a training ray read the row."""

    def of_rows(self, count: int) -> Tables:
        """The tables as compiled code reads them."""
        density, reliability = (shaped(x, count, 1) for x in (self.density, self.reliability))
        return Tables(density, reliability, shaped(self.touched, count, dtype=torch.uint8))


class Places(NamedTuple):
    """Positions of samples, in S slots of every ray."""

    heads: Int[Tensor, "R S"]
    planes: Int[Tensor, "R S"]
    """Meaningless in the cube."""
    ndc: Float[Tensor, "R S 3"]
    """Position in the head."""
    valid: Bool[Tensor, "R S"]
    """Which slots hold a sample."""


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """Constants of K MPIs, and of the cube if there is one (H heads, the cube last), at the resolution in use."""

    mpis: tuple[MPIPlan, ...]
    frames: Frames
    grids: list[TexelGrid]
    """Texels of all heads."""
    biases: list[Float[Tensor, "L"]]
    """Of the raw densities of each MPI's planes."""
    depth_scale: float = 1.0
    """Factor on every optical depth of an MPI."""
    cube: Cube | None = None
    cube_bias: float = 0.0
    cube_interval: float = 1.0
    content_near: float = 0.0
    """Distance to the first content."""
    packed: dict[str, Any] = field(default_factory=dict)
    """The same in the layout of the compiled operations, made by them once."""

    @property
    def num_heads(self) -> int:
        return len(self.grids)

    def once(self, name: str, make: Callable[[SceneLayout], Any]) -> Any:
        """What ``make`` makes of the layout, made at first use."""
        # Where threads make it at once the first one's stays: compiled operations hold addresses in it.
        return self.packed[name] if name in self.packed else self.packed.setdefault(name, make(self))

    @property
    def num_rows(self) -> int:
        """Rows of the pooled tables."""
        return len(self.grids[0].places) * BRICK

    @property
    def sizes(self) -> dict[str, int]:
        """What letters in shapes stand for: rows of the tables, heads and MPIs."""
        return {"T": self.num_rows, "H": self.num_heads, "K": len(self.mpis)}

    @cached_property
    def most_samples(self) -> int:
        """No ray has more: planes of all MPIs, and the cube's diagonal in steps."""
        cube, planes = self.cube, sum(m.planes for m in self.mpis)
        if cube is None:
            return planes
        return planes + int(2 * math.hypot(*(cube.upper - cube.lower).tolist()) / cube.step) + 2

    @cached_property
    def head_rows(self) -> Float[Tensor, "K 9"]:
        """Of each MPI: disparity between planes and of the last one, 1 - near / far, scale of the NDC s, lower end and
        scale of u and of v, interval."""
        rows = []
        for k, (mpi, step) in enumerate(zip(self.mpis, self.frames.disparity_steps.tolist(), strict=True)):
            u0, u1, v0, v1 = mpi.extent
            depth = (step, mpi.last_disparity, mpi.depth_share, 2 * mpi.near / mpi.depth_share)
            rows.append((*depth, u0, 2 / (u1 - u0), v0, 2 / (v1 - v0), self.interval(k)))
        return torch.tensor(rows, dtype=torch.float32, device=self.frames.origins.device).reshape(len(rows), 9)

    @cached_property
    def cube_row(self) -> Float[Tensor, "12"]:
        """Lower corner, extent, step between samples, bias, interval, upper corner; zeros without a cube."""
        cube, numbers = self.cube, [0.0] * 12
        if cube is not None:
            corner, extent = cube.lower.tolist(), (cube.upper - cube.lower).tolist()
            numbers = [*corner, *extent, cube.step, self.cube_bias, self.cube_interval, *cube.upper.tolist()]
        return torch.tensor(numbers, dtype=torch.float32, device=self.frames.origins.device)

    def bias_starts(self) -> list[int]:
        """Where each head's planes begin in the list of all biases."""
        return [sum(len(b) for b in self.biases[:k]) for k in range(self.num_heads)]

    def interval(self, k: int) -> float:
        """Factor of head k's softplus: what a sample of it stands for."""
        return self.cube_interval if k >= len(self.mpis) else 256.0 / self.mpis[k].planes * self.depth_scale

    def optical_depth(self, k: int, raw: Float[Tensor, "N"], planes: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """tau from head k's raw densities: softplus(raw + bias) times the interval, in float32 or wider."""
        raw = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
        bias = self.cube_bias if k >= len(self.mpis) else self.biases[k][planes]
        return torch.nn.functional.softplus(raw + bias) * self.interval(k)


def frame_rows(frames: Frames) -> Float[Tensor, "K 19"]:
    """Of each MPI: origin, axes, extent, disparity between planes and of the last one, number of the first one."""
    columns = (frames.disparity_steps, frames.last_disparities, frames.num_planes - 1)
    parts = (frames.origins, frames.axes.flatten(1), frames.extents, *(x[:, None] for x in columns))
    return torch.cat([x.float() for x in parts], -1).contiguous()


def shaped(x: Tensor, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """A tensor as compiled code reads it, which checks nothing itself: contiguous, of this shape and type."""
    assert x.shape == shape and x.dtype == dtype, f"{list(x.shape)} {x.dtype} where {list(shape)} {dtype} is read"
    return x.contiguous()
