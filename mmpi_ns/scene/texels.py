"""Texel rows and interpolation weights of lookups: index arithmetic over one pooled table.

Density, features and reliability each have one table, shared by all heads. A table is a list of bricks of ``BRICK``
rows, the ``SIDE`` x ``SIDE`` texels of one tile of a plane (row by row). ``tiles`` maps tiles to bricks: head by head,
plane by plane from near to far (in the cube: layer by layer), tile row by tile row. Brick 0 is shared by all empty
tiles.

    row of texel (plane, y, x) = tiles[first_tile + (plane * down + y // 8) * across + x // 8] * 64 + y % 8 * 8 + x % 8
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.scene.plan import ScenePlan

SIDE = 8
"""Texels along each side of a brick."""
BRICK = SIDE * SIDE
"""Rows of a brick. The first brick of every table is the empty one, which must not change."""


@dataclass(frozen=True, eq=False)
class TexelGrid:
    """One head's texels: ``depth`` planes (or z layers) of ``height`` x ``width``."""

    depth: int
    height: int
    width: int
    down: int
    """Rows of tiles of a plane,"""
    across: int
    """and tiles in a row."""
    is_cube: bool
    first_tile: int
    """Index of the head's first tile among those of all heads."""
    tiles: Int[Tensor, "T"]
    """Brick of every tile of all heads (int32); 0 for empty tiles."""
    places: Int[Tensor, "B"]
    """Tile of every brick (int64); -1 for the empty one."""

    @property
    def own_tiles(self) -> Int[Tensor, "D Y X"]:
        """Brick of each of the head's tiles."""
        shape = self.depth, self.down, self.across
        return self.tiles[self.first_tile :][: math.prod(shape)].view(shape)

    @property
    def rows(self) -> Int[Tensor, "D*H*W"]:
        """Row of every texel, in reading order: ``table[grid.rows].view(depth, height, width, -1)`` is the block."""
        z, y, x = (torch.arange(n, device=self.tiles.device) for n in (self.depth, self.height, self.width))
        return self.row(z[:, None, None], y[:, None], x).reshape(-1)

    def row(self, z: Int[Tensor, "*#N"], y: Int[Tensor, "*#N"], x: Int[Tensor, "*#N"]) -> Int[Tensor, "*N"]:
        """Row of the texel in column x and row y of plane z."""
        tile = self.first_tile + (z * self.down + (y >> 3)) * self.across + (x >> 3)
        brick = self.tiles.index_select(0, tile.reshape(-1)).view(tile.shape)
        return (brick.to(torch.int64) << 6) + ((y & 7) << 3) + (x & 7)

    def bilinear(
        self, plane: Int[Tensor, "N"], uv: Float[Tensor, "N 2"]
    ) -> tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]]:
        """Rows and weights at NDC ``uv`` on plane index ``plane`` (0 is the nearest). Corners are texel centres."""
        return self._corners(plane[None], torch.ones_like(uv[None, :, 0]), uv)

    def _corners(self, planes: Int[Tensor, "P N"], shares: Float[Tensor, "P N"], uv: Tensor) -> tuple[Tensor, Tensor]:
        """``bilinear`` on P planes at once, with their weights: few operations, however many texels."""
        (x, fx), (y, fy) = _cell(uv[:, 0], self.width), _cell(uv[:, 1], self.height)
        x, y, wx, wy = (torch.stack(pair) for pair in ((x, x + 1), (y, y + 1), (1 - fx, fx), (1 - fy, fy)))
        rows, weights = self.row(planes[:, None, None], y[:, None], x), shares[:, None, None] * (wy[:, None] * wx)
        return rows.flatten(0, 2).T.contiguous(), weights.flatten(0, 2).T.contiguous()

    def trilinear(
        self, ndc: Float[Tensor, "N 3"], planes: Int[Tensor, "N"] | None = None
    ) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
        """Rows and weights at NDC (u, v, s) in [-1, 1]^3, s running over planes (or z layers).

        ``planes``: of samples on a plane, which read its four texels and those again with weight 0; -1 for the others.
        """
        z, fz = _cell(ndc[:, 2], self.depth)
        z = torch.stack([z, z + 1])
        if planes is not None:
            z, fz = torch.where(planes < 0, z, planes), fz * (planes < 0)
        return self._corners(z, torch.stack([1 - fz, fz]), ndc)

    def nearest(self, ndc: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
        """Row of the texel nearest to NDC (u, v, s)."""
        x, y, z = (
            ((ndc[:, i] + 1) * (0.5 * (n - 1))).round().clamp(0, n - 1).to(torch.int64)
            for i, n in enumerate((self.width, self.height, self.depth))
        )
        return self.row(z, y, x)

    def holds(self, rows: Int[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Mask of the rows of this head; those of the empty brick belong to none."""
        place = self.places[rows >> 6]
        return (place >= self.first_tile) & (place < self.first_tile + self.own_tiles.numel())

    def texel(self, rows: Int[Tensor, "N"]) -> tuple[Int[Tensor, "N"], Int[Tensor, "N"], Int[Tensor, "N"]]:
        """(plane, y, x) of rows that this head ``holds``: the inverse of ``row``."""
        tile = self.places[rows >> 6] - self.first_tile
        x = (tile % self.across) * SIDE + (rows & 7)
        y = (tile // self.across % self.down) * SIDE + (rows >> 3 & 7)
        return tile // (self.across * self.down), y, x

    def neighbours(self, rows: Int[Tensor, "N"]) -> tuple[Int[Tensor, "N 6"], Float[Tensor, "N 6"]]:
        """Rows of the texels beside each row along x, y and z (-, +); 1 where one is stored, else the row itself."""
        z, y, x = self.texel(rows)
        beside_rows, exists = [], []
        for dz, dy, dx in ((0, 0, -1), (0, 0, 1), (0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0)):
            beside = (z + dz, y + dy, x + dx)
            inside = torch.ones_like(rows, dtype=torch.bool)
            for i, n in zip(beside, (self.depth, self.height, self.width), strict=True):
                inside &= (i >= 0) & (i < n)
            other = self.row(*(torch.where(inside, i, j) for i, j in zip(beside, (z, y, x), strict=True)))
            inside &= other >= BRICK
            beside_rows.append(torch.where(inside, other, rows))
            exists.append(inside)
        return torch.stack(beside_rows, -1), torch.stack(exists, -1).to(torch.float32)


def _cell(coordinate: Float[Tensor, "N"], size: int) -> tuple[Int[Tensor, "N"], Float[Tensor, "N"]]:
    """Lower texel and fraction of a coordinate in [-1, 1] over ``size`` texels; outside it clamps to the border."""
    last = size - 1
    position = ((coordinate + 1) * (0.5 * last)).clamp(min=0).clamp(max=last)
    lower = position.floor().clamp(max=last - 1)
    return lower.to(torch.int64), position - lower


def head_grids(plan: ScenePlan, tiles: Int[Tensor, "T"] | None = None) -> list[TexelGrid]:
    """The texels of every head, MPIs first, the cube last. ``tiles``: None stores all of them in order."""
    return make_grids(head_shapes(plan), tiles, plan.cube is not None)


def head_shapes(plan: ScenePlan) -> list[tuple[int, int, int]]:
    """Planes (or layers), rows and columns of every head, the cube last."""
    return [(m.planes, m.height, m.width) for m in plan.mpis] + ([plan.cube.shape] if plan.cube is not None else [])


def make_grids(
    shapes: list[tuple[int, int, int]], tiles: Int[Tensor, "T"] | None = None, with_cube: bool = False
) -> list[TexelGrid]:
    """Grids of these sizes, one after the other; ``with_cube``: the last one is the cube."""
    sides = [(-(-height // SIDE), -(-width // SIDE)) for _, height, width in shapes]
    counts = [depth * math.prod(side) for (depth, _, _), side in zip(shapes, sides, strict=True)]
    if tiles is None:
        tiles = torch.arange(1, sum(counts) + 1, dtype=torch.int32)
    assert len(tiles) == sum(counts), (len(tiles), shapes)
    stored = tiles.nonzero()[:, 0]
    places = torch.full((len(stored) + 1,), -1, dtype=torch.int64, device=tiles.device)
    places[tiles[stored].to(torch.int64)] = stored
    return [
        TexelGrid(*shape, *side, with_cube and k == len(shapes) - 1, sum(counts[:k]), tiles, places)
        for k, (shape, side) in enumerate(zip(shapes, sides, strict=True))
    ]


def number_tiles(stored: Bool[Tensor, "T"]) -> Int[Tensor, "T"]:
    """``tiles`` with a brick for each chosen tile."""
    return torch.where(stored, stored.cumsum(0), 0).to(torch.int32)
