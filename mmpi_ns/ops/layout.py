"""What the operations know of a scene: MPIs and cube, where their texels are, and from raw density to optical depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from mmpi_ns.scene.geometry import Cube, Frames
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.scene.texels import TexelGrid


class Tables(NamedTuple):
    """The pooled tables that a ray is marched through, of T rows."""

    density: Float[Tensor, "T 1"]
    """Raw densities."""
    reliability: Float[Tensor, "T 1"]
    """R, or the shares P that were baked from it."""
    touched: UInt8[Tensor, "T"]
    """1 where a training ray read the row."""


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """Constants of K MPIs, and of the cube where there is one (H heads, the cube last), at the resolution in use."""

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
    packed: dict[str, Any] = field(default_factory=dict)
    """The same as the compiled operations read it, made by them once."""

    @property
    def num_heads(self) -> int:
        return len(self.grids)

    def once(self, name: str, make: Callable[[SceneLayout], Any]) -> Any:
        """What ``make`` makes of the layout, made at first use."""
        found = self.packed.get(name)
        # Where threads make it at once the first one's stays: compiled operations hold addresses in it.
        return self.packed.setdefault(name, make(self)) if found is None else found

    def interval(self, k: int) -> float:
        """Factor of head k's softplus: what a sample of it stands for."""
        return self.cube_interval if k >= len(self.mpis) else 256.0 / self.mpis[k].planes * self.depth_scale

    def optical_depth(self, k: int, raw: Float[Tensor, "N"], planes: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """tau from head k's raw densities: softplus(raw + bias) times the interval, in float32 or wider."""
        raw = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
        bias = self.cube_bias if k >= len(self.mpis) else self.biases[k][planes]
        return torch.nn.functional.softplus(raw + bias) * self.interval(k)
