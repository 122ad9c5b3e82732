"""Which texels a lookup reads, and with which weights. Pure index arithmetic over one pooled table.

All heads share one table a kind (density, features, reliability): head k owns the rows from ``offset`` on, stored
plane-major (plane, row, column), planes near to far. The cube is stored (z, y, x).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.placement.plan import ScenePlan


@dataclass(frozen=True)
class TexelGrid:
    """One head's block of the pooled table: ``depth`` planes (or z layers) of ``height`` x ``width`` texels."""

    offset: int
    depth: int
    height: int
    width: int

    @property
    def texels(self) -> int:
        return self.depth * self.height * self.width

    @property
    def rows(self) -> slice:
        return slice(self.offset, self.offset + self.texels)

    def bilinear(
        self, plane: Int[Tensor, "N"], uv: Float[Tensor, "N 2"]
    ) -> tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]]:
        """Rows and weights at NDC ``uv`` on plane index ``plane`` (0 is the nearest). Corners are texel centres."""
        x, fx = _cell(uv[:, 0], self.width)
        y, fy = _cell(uv[:, 1], self.height)
        base = self.offset + (plane * self.height + y) * self.width + x
        return self._corners(base, fx, fy)

    def trilinear(self, ndc: Float[Tensor, "N 3"]) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
        """Rows and weights at NDC (u, v, s) in [-1, 1]^3, s running over planes (or z layers)."""
        x, fx = _cell(ndc[:, 0], self.width)
        y, fy = _cell(ndc[:, 1], self.height)
        z, fz = _cell(ndc[:, 2], self.depth)
        base = self.offset + (z * self.height + y) * self.width + x
        near_rows, weights = self._corners(base, fx, fy)
        rows = torch.cat([near_rows, near_rows + self.height * self.width], -1)
        return rows, torch.cat([weights * (1 - fz)[:, None], weights * fz[:, None]], -1)

    def nearest(self, ndc: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
        """Row of the texel nearest to NDC (u, v, s)."""
        x, y, z = (
            ((ndc[:, i] + 1) * (0.5 * (n - 1))).round().clamp(0, n - 1).to(torch.int64)
            for i, n in enumerate((self.width, self.height, self.depth))
        )
        return self.offset + (z * self.height + y) * self.width + x

    def neighbours(self, rows: Int[Tensor, "N"]) -> tuple[Int[Tensor, "N 6"], Float[Tensor, "N 6"]]:
        """Rows of the texels beside each row along x, y and z (-, +); 1 where there is one, else the row itself."""
        local = rows - self.offset
        x, y = local % self.width, (local // self.width) % self.height
        z = local // (self.width * self.height)
        layer = self.width * self.height
        exists = torch.stack([x > 0, x < self.width - 1, y > 0, y < self.height - 1, z > 0, z < self.depth - 1], -1)
        steps = torch.tensor([-1, 1, -self.width, self.width, -layer, layer], device=rows.device)
        return torch.where(exists, rows[:, None] + steps, rows[:, None]), exists.to(torch.float32)

    def _corners(self, base: Tensor, fx: Tensor, fy: Tensor) -> tuple[Tensor, Tensor]:
        steps = torch.tensor([0, 1, self.width, self.width + 1], device=base.device)
        gx, gy = 1 - fx, 1 - fy
        return base[:, None] + steps, torch.stack([gx * gy, fx * gy, gx * fy, fx * fy], -1)


def _cell(coordinate: Float[Tensor, "N"], size: int) -> tuple[Int[Tensor, "N"], Float[Tensor, "N"]]:
    """Lower texel and fraction of a coordinate in [-1, 1] over ``size`` texels; outside it clamps to the border."""
    position = ((coordinate + 1) * (0.5 * (size - 1))).clamp(0, size - 1)
    lower = position.floor().clamp(max=size - 2)
    return lower.to(torch.int64), position - lower


def head_grids(plan: ScenePlan) -> list[TexelGrid]:
    """The texel block of every head, MPIs first, the cube last."""
    shapes = [(m.planes, m.height, m.width) for m in plan.mpis]
    if plan.cube is not None:
        shapes.append(plan.cube.shape)
    grids, offset = [], 0
    for depth, height, width in shapes:
        grids.append(TexelGrid(offset, depth, height, width))
        offset += grids[-1].texels
    return grids


def resample(
    table: Float[Tensor, "T C"], old: list[TexelGrid], new: list[TexelGrid], is_cube: list[bool]
) -> Float[Tensor, "T2 C"]:
    """The table at another resolution: bilinear on every plane of an MPI, trilinear in the cube (paper growth)."""
    blocks = []
    for source, target, cube in zip(old, new, is_cube, strict=True):
        block = table[source.rows].view(source.depth, source.height, source.width, -1)
        if cube:
            volume = block.permute(3, 0, 1, 2)[None]
            size = (target.depth, target.height, target.width)
            out = torch.nn.functional.interpolate(volume, size=size, mode="trilinear", align_corners=True)
            blocks.append(out[0].permute(1, 2, 3, 0).reshape(target.texels, -1))
        else:
            images = block.permute(0, 3, 1, 2)
            size = (target.height, target.width)
            out = torch.nn.functional.interpolate(images, size=size, mode="bilinear", align_corners=True)
            blocks.append(out.permute(0, 2, 3, 1).reshape(target.texels, -1))
    return torch.cat(blocks)
