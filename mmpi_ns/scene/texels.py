"""Tables of texels: which ones a lookup reads with which weights, and how tables are filled, grown and compacted.

Density, features and reliability each have one table, shared by all heads. A table is a list of bricks of ``BRICK``
rows, the ``SIDE`` x ``SIDE`` texels of one tile of a plane (row by row). ``tiles`` maps tiles to bricks: head by head,
plane by plane from near to far (in the cube: layer by layer), tile row by tile row. Brick 0 is shared by all empty
tiles.

    row of texel (plane, y, x) = tiles[first_tile + (plane * down + y // 8) * across + x // 8] * 64 + y % 8 * 8 + x % 8
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d, pad

from mmpi_ns.scene.plan import FINER, ScenePlan
from mmpi_ns.utils.machine import lazy_zeros

SIDE = 8
"""Texels along each side of a brick."""
BRICK = SIDE * SIDE
"""Rows of a brick. The first brick of every table is the empty one, which must not change."""
CHUNK = 1 << 17
"""Texels of an MPI that are resampled at once: for nine channels this takes some 40 MB besides both tables."""


@dataclass(frozen=True, eq=False)
class TexelGrid:
    """One head's texels: ``depth`` planes (or z layers) of ``height`` x ``width``."""

    depth: int
    height: int
    width: int
    first_tile: int
    """Index of the head's first tile among those of all heads."""
    tiles: Int[Tensor, "T"]
    """Brick of every tile of all heads (int32); 0 for empty tiles."""
    places: Int[Tensor, "B"]
    """Tile of every brick (int64); -1 for the empty one."""

    @property
    def down(self) -> int:
        return -(-self.height // SIDE)

    @property
    def across(self) -> int:
        return -(-self.width // SIDE)

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
        x, fx = _cell(uv[:, 0], self.width)
        y, fy = _cell(uv[:, 1], self.height)
        gx, gy = 1 - fx, 1 - fy
        rows = torch.stack([self.row(plane, y + dy, x + dx) for dy in (0, 1) for dx in (0, 1)], -1)
        return rows, torch.stack([gx * gy, fx * gy, gx * fy, fx * fy], -1)

    def trilinear(self, ndc: Float[Tensor, "N 3"]) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
        """Rows and weights at NDC (u, v, s) in [-1, 1]^3, s running over planes (or z layers)."""
        z, fz = _cell(ndc[:, 2], self.depth)
        (near, weights), (far, _) = self.bilinear(z, ndc), self.bilinear(z + 1, ndc)
        return torch.cat([near, far], -1), torch.cat([weights * (1 - fz)[:, None], weights * fz[:, None]], -1)

    def nearest(self, ndc: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
        """Row of the texel nearest to NDC (u, v, s)."""
        x, y, z = (
            ((ndc[:, i] + 1) * (0.5 * (n - 1))).round().clamp(0, n - 1).to(torch.int64)
            for i, n in enumerate((self.width, self.height, self.depth))
        )
        return self.row(z, y, x)

    def holds(self, rows: Int[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Which rows belong to this head; those of the empty brick belong to none."""
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
    position = ((coordinate + 1) * (0.5 * (size - 1))).clamp(0, size - 1)
    lower = position.floor().clamp(max=size - 2)
    return lower.to(torch.int64), position - lower


def head_grids(plan: ScenePlan, tiles: Int[Tensor, "T"] | None = None) -> list[TexelGrid]:
    """The texels of every head, MPIs first, the cube last.

    Args:
        plan: sizes of the heads.
        tiles: brick of every tile; None stores all of them in order.
    """
    return make_grids(head_shapes(plan), tiles)


def head_shapes(plan: ScenePlan) -> list[tuple[int, int, int]]:
    """Planes (or layers), rows and columns of every head, the cube last."""
    return [(m.planes, m.height, m.width) for m in plan.mpis] + ([plan.cube.shape] if plan.cube is not None else [])


def make_grids(shapes: list[tuple[int, int, int]], tiles: Int[Tensor, "T"] | None = None) -> list[TexelGrid]:
    """Grids of the given sizes, stored one after the other."""
    counts = [depth * -(-height // SIDE) * -(-width // SIDE) for depth, height, width in shapes]
    if tiles is None:
        tiles = torch.arange(1, sum(counts) + 1, dtype=torch.int32)
    assert len(tiles) == sum(counts), (len(tiles), shapes)
    stored = tiles.nonzero()[:, 0]
    places = torch.full((len(stored) + 1,), -1, dtype=torch.int64, device=tiles.device)
    places[tiles[stored].to(torch.int64)] = stored
    return [TexelGrid(*s, sum(counts[:k]), tiles, places) for k, s in enumerate(shapes)]


def number_tiles(stored: Bool[Tensor, "T"]) -> Int[Tensor, "T"]:
    """``tiles`` in which the chosen tiles have a brick each."""
    return torch.where(stored, stored.cumsum(0), 0).to(torch.int32)


def new_table(tiles: Int[Tensor, "T"], channels: int, empty: float = 0.0, dtype=torch.float32) -> Float[Tensor, "N C"]:
    """A table of zeros with a brick for every stored tile; the empty brick contains ``empty``."""
    bricks = int((tiles > 0).sum()) + 1
    table = torch.zeros(bricks * BRICK, channels, dtype=dtype, device=tiles.device)
    table[:BRICK] = empty
    return table


def read_planes(table: Float[Tensor, "N C"], grid: TexelGrid, planes: slice) -> Float[Tensor, "P H W C"]:
    """Texels of some planes of one head, as images."""
    tiles = grid.own_tiles[planes]
    blocks = table.view(-1, SIDE, SIDE, table.shape[-1])[tiles.to(torch.int64)]
    images = blocks.permute(0, 1, 3, 2, 4, 5).reshape(len(tiles), grid.down * SIDE, grid.across * SIDE, -1)
    return images[:, : grid.height, : grid.width]


def write_planes(table: Float[Tensor, "N C"], grid: TexelGrid, planes: slice, images: Float[Tensor, "P H W C"]) -> None:
    """Stores images in the existing bricks; texels of other tiles are left out."""
    tiles = grid.own_tiles[planes]
    stored = tiles > 0
    below, right = grid.down * SIDE - grid.height, grid.across * SIDE - grid.width
    padded = pad(images, (0, 0, 0, right, 0, below))
    blocks = padded.view(len(tiles), grid.down, SIDE, grid.across, SIDE, -1).permute(0, 1, 3, 2, 4, 5)
    table.view(-1, SIDE, SIDE, table.shape[-1])[tiles[stored].to(torch.int64)] = blocks[stored]


def keep_bricks(tiles: Int[Tensor, "T"], keep: Bool[Tensor, "B"]) -> tuple[Int[Tensor, "T"], Int[Tensor, "K"]]:
    """``tiles`` without the released bricks, and the previous numbers of the others (including 0)."""
    keep = keep.clone()
    keep[0] = True
    numbers = (keep.cumsum(0) - 1) * keep
    return numbers[tiles.to(torch.int64)].to(torch.int32), keep.nonzero()[:, 0]


def take_bricks(table: Float[Tensor, "N C"], kept: Int[Tensor, "K"]) -> Float[Tensor, "M C"]:
    """The chosen bricks of a table."""
    return table.view(-1, BRICK, *table.shape[1:])[kept].flatten(0, 1)


def grown_tiles(
    old: list[TexelGrid],
    new: list[TexelGrid],
    is_cube: list[bool],
    reachable: Bool[Tensor, "T"] | None,
    least: float = 0.0,
) -> Int[Tensor, "T"]:
    """``tiles`` at another resolution, with the tiles that a stored texel of the old one and a training ray reach.

    Args:
        old: current heads.
        new: heads at the new resolution; their tiles are not read.
        is_cube: which of them is the cube.
        reachable: tiles that training rays cross; None for all.
        least: share of stored texels in an interpolated one from which (0: above which) it is stored.
    """
    stored = torch.zeros_like(new[0].tiles, dtype=torch.bool)
    for source, target, cube in zip(old, new, is_cube, strict=True):
        for sources, planes in _chunks(target, cube):
            share = _resize(stored_texels(source, sources).float(), target, cube)[..., 0]
            there = share >= least if least else share > 0
            reached = pad(there.float(), (0, -target.width % SIDE, 0, -target.height % SIDE))
            tiles = max_pool2d(reached[:, None], SIDE)[:, 0] > 0
            first = target.first_tile + planes.start * target.down * target.across
            stored[first : first + tiles.numel()] = tiles.reshape(-1).cpu()
    return number_tiles(stored if reachable is None else stored & reachable)


def tiles_with_copies(
    grids: list[TexelGrid], copies: list[TexelGrid], chosen: Bool[Tensor, "T"]
) -> tuple[Bool[Tensor, "S"], Bool[Tensor, "T"]]:
    """Tiles that finer copies of MPIs store of chosen ones, and those that the MPIs themselves go on storing.

    A chosen tile has FINER x FINER tiles in the copy. The MPI gives it up where all stored tiles around it are chosen
    too, so copy and MPI overlap by a tile and no seam is seen.

    Args:
        grids: all heads, MPIs first.
        copies: of the MPIs, at their resolution; their tiles are not read.
        chosen: stored tiles of MPIs.

    Returns:
        Tiles of the copies, and of all heads.
    """
    stored, fine = grids[0].tiles > 0, torch.zeros_like(copies[0].tiles, dtype=torch.bool)
    kept = stored.clone()
    for grid, copy in zip(grids, copies, strict=False):
        here = slice(grid.first_tile, grid.first_tile + grid.own_tiles.numel())
        taken = chosen[here].view(grid.own_tiles.shape)
        beside = max_pool2d((stored[here].view_as(taken) & ~taken)[:, None].float(), 3, 1, 1)[:, 0] > 0
        kept[here] &= (~taken | beside).reshape(-1)
        wide = taken.repeat_interleave(FINER, 1).repeat_interleave(FINER, 2)[:, : copy.down, : copy.across]
        fine[copy.first_tile :][: wide.numel()] = wide.reshape(-1)
    return fine, kept


def widened_tiles(grids: list[TexelGrid], chosen: Bool[Tensor, "T"]) -> Bool[Tensor, "T"]:
    """Chosen tiles and the stored ones around them, on their planes."""
    wide = chosen.clone()
    for grid in grids:
        here = slice(grid.first_tile, grid.first_tile + grid.own_tiles.numel())
        images = chosen[here].view(grid.own_tiles.shape)[:, None].float()
        wide[here] |= (max_pool2d(images, 3, 1, 1) > 0).reshape(-1)
    return wide & (grids[0].tiles > 0)


def resample(
    table: Float[Tensor, "N C"], old: list[TexelGrid], new: list[TexelGrid], is_cube: list[bool], empty: float = 0.0
) -> Float[Tensor, "M C"]:
    """The table at another resolution: bilinear on every plane of an MPI, trilinear in the cube (paper growth).

    Texels next to an empty tile extend the stored ones. Planes are processed a few at a time, so only the old and the
    new table need memory.
    """
    if not empty and not bool(table.any()):  # untrained reliability takes no memory
        return lazy_zeros((int((new[0].tiles > 0).sum() + 1) * BRICK, table.shape[-1]), table.dtype, table.device)
    out = new_table(new[0].tiles, table.shape[-1], empty, table.dtype)
    for source, target, cube in zip(old, new, is_cube, strict=True):
        for sources, planes in _chunks(target, cube):
            if not bool(target.own_tiles[planes].any()):
                continue
            images = read_planes(table, source, sources)
            stored = stored_texels(source, sources).to(table.dtype)
            if bool(stored.all()):
                write_planes(out, target, planes, _resize(images, target, cube))
                continue
            there, value = _resize(stored, target, cube), _resize(images * stored, target, cube)
            value = torch.where(there > 1 - 1e-6, value, value / there.clamp(min=1e-12))
            write_planes(out, target, planes, torch.where(there > 0, value, empty))
    return out


def _chunks(target: TexelGrid, is_cube: bool) -> Iterator[tuple[slice, slice]]:
    """A few planes at a time: where they come from and where they go. The cube's layers go together."""
    step = target.depth if is_cube else max(1, CHUNK // (target.height * target.width))
    for start in range(0, target.depth, step):
        planes = slice(start, min(start + step, target.depth))
        yield (slice(None) if is_cube else planes), planes


def stored_texels(grid: TexelGrid, planes: slice) -> Bool[Tensor, "P h w 1"]:
    """Which texels of some planes are stored."""
    wide = (grid.own_tiles[planes] > 0).repeat_interleave(SIDE, 1).repeat_interleave(SIDE, 2)
    return wide[:, : grid.height, : grid.width, None]


def _resize(images: Float[Tensor, "P h w C"], target: TexelGrid, is_cube: bool) -> Float[Tensor, "Q H W C"]:
    """Images of another size, corners on corners; the layers of a cube are resized as well."""
    if is_cube:
        size = (target.depth, target.height, target.width)
        out = interpolate(images.permute(3, 0, 1, 2)[None], size=size, mode="trilinear", align_corners=True)
        return out[0].permute(1, 2, 3, 0)
    size = (target.height, target.width)
    return interpolate(images.permute(0, 3, 1, 2), size=size, mode="bilinear", align_corners=True).permute(0, 2, 3, 1)
