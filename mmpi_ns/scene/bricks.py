"""Allocation, filling, growth and compaction of tables of bricks, and columns of them. Rows: ``texels.py``."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d, pad

from mmpi_ns.scene.plan import FINER
from mmpi_ns.scene.texels import BRICK, SIDE, TexelGrid, number_tiles
from mmpi_ns.utils.pages import FORGET, advise, all_zero, empty_table, lazy_zeros

CHUNK = 1 << 17
"""Texels of an MPI that are resampled at once: for nine channels this takes some 40 MB besides both tables."""
AT_ONCE = 1 << 23
"""Bytes of bricks that are moved at once."""
WORD = 32
"""Planes of a column: bits of the occupied ones of so many consecutive planes of a tile, so that a ray skips the
others."""


def new_table(tiles: Int[Tensor, "T"], channels: int, empty: float = 0.0, dtype=torch.float32) -> Float[Tensor, "N C"]:
    """A table of zeros with a brick for every stored tile; the empty brick contains ``empty``."""
    bricks = int((tiles > 0).sum()) + 1
    table = empty_table((bricks * BRICK, channels), dtype, tiles.device).zero_()
    table[:BRICK] = empty
    return table


def write_planes(table: Float[Tensor, "N C"], grid: TexelGrid, planes: slice, images: Float[Tensor, "P H W C"]) -> None:
    """Writes images into the existing bricks; texels of other tiles are skipped."""
    tiles = grid.own_tiles[planes]
    stored = tiles > 0
    below, right = grid.down * SIDE - grid.height, grid.across * SIDE - grid.width
    padded = pad(images, (0, 0, 0, right, 0, below))
    blocks = padded.view(len(tiles), grid.down, SIDE, grid.across, SIDE, -1).permute(0, 1, 3, 2, 4, 5)
    table.view(-1, SIDE, SIDE, table.shape[-1])[tiles[stored].to(torch.int64)] = blocks[stored]


def move_bricks(table: Shaped[Tensor, "N ..."], kept: Int[Tensor, "K"]) -> Shaped[Tensor, "M ..."]:
    """The bricks ``kept``, in ascending order, of a table or its moments, which is consumed: memory of copied bricks is
    freed, so that the peak is one table and a few bricks."""
    bricks, shape = table.view(-1, BRICK, *table.shape[1:]), (len(kept) * BRICK, *table.shape[1:])
    if all_zero(table):
        return lazy_zeros(shape, table.dtype, table.device)
    moved, passed = empty_table(shape, table.dtype, table.device), 0
    step = max(1, AT_ONCE // (bricks[0].numel() * table.element_size()))
    for start in range(0, len(kept), step):
        part = kept[start : start + step]
        torch.index_select(bricks, 0, part, out=moved.view(-1, *bricks.shape[1:])[start : start + step])
        last = int(part[-1]) + 1
        advise(bricks[passed:last], FORGET)
        passed = last
    return moved


def grown_tiles(
    old: list[TexelGrid],
    new: list[TexelGrid],
    reachable: Bool[Tensor, "T"] | None,
    least: float = 0.0,
) -> Int[Tensor, "T"]:
    """``tiles`` at another resolution, with the tiles that a stored texel of the old one and a training ray reach
    (None: all are reachable). Tiles of the ``new`` heads are not read. ``least``: minimum weight of stored texels in an
    interpolated one for it to be stored (0: any)."""
    stored = torch.zeros_like(new[0].tiles, dtype=torch.bool)
    for source, target in zip(old, new, strict=True):
        for sources, planes in _chunks(target):
            share = _resize(stored_texels(source, sources).float(), target)[..., 0]
            there = share >= least if least else share > 0
            reached = pad(there.float(), (0, -target.width % SIDE, 0, -target.height % SIDE))
            tiles = max_pool2d(reached[:, None], SIDE)[:, 0] > 0
            first = target.first_tile + planes.start * target.down * target.across
            stored[first : first + tiles.numel()] = tiles.reshape(-1).cpu()
    return number_tiles(stored if reachable is None else stored & reachable)


def tiles_with_copies(
    grids: list[TexelGrid], copies: list[TexelGrid], chosen: Bool[Tensor, "T"]
) -> tuple[Bool[Tensor, "S"], Bool[Tensor, "T"]]:
    """Tiles stored by finer copies of MPIs for chosen ones, and tiles that the MPIs continue to store.

    A chosen tile has FINER x FINER tiles in the copy. The MPI drops it if all stored tiles around it are chosen too: in
    others both count, and training adapts them.

    ``grids`` are all heads, MPIs first; the tiles of ``copies`` are not read. Returns tiles of the copies, and of all
    heads.
    """
    stored = grids[0].tiles > 0
    fine = stored.new_zeros(len(copies[0].tiles))
    kept = stored.clone()
    for grid, copy in zip(grids, copies, strict=False):
        here = slice(grid.first_tile, grid.first_tile + grid.own_tiles.numel())
        taken = chosen[here].view(grid.own_tiles.shape)
        beside = max_pool2d((stored[here].view_as(taken) & ~taken)[:, None].float(), 3, 1, 1)[:, 0] > 0
        kept[here] &= (~taken | beside).reshape(-1)
        wide = taken.repeat_interleave(FINER, 1).repeat_interleave(FINER, 2)[:, : copy.down, : copy.across]
        fine[copy.first_tile :][: wide.numel()] = wide.reshape(-1)
    return fine, kept


def resample(
    table: Float[Tensor, "N C"], old: list[TexelGrid], new: list[TexelGrid], empty: float = 0.0
) -> Float[Tensor, "M C"]:
    """The table at another resolution: bilinear on every plane of an MPI, trilinear in the cube (paper growth).

    Texels next to an empty tile extend the stored ones. Planes are processed a few at a time, so only the old and the
    new table need memory.
    """
    if not empty and all_zero(table):
        return lazy_zeros((int((new[0].tiles > 0).sum() + 1) * BRICK, table.shape[-1]), table.dtype, table.device)
    out = new_table(new[0].tiles, table.shape[-1], empty, table.dtype)
    for source, target in zip(old, new, strict=True):
        for sources, planes in _chunks(target):
            if not bool(target.own_tiles[planes].any()):
                continue
            bricks = source.own_tiles[sources].to(torch.int64)
            blocks = table.view(-1, SIDE, SIDE, table.shape[-1])[bricks].permute(0, 1, 3, 2, 4, 5)
            images = blocks.reshape(len(bricks), source.down * SIDE, source.across * SIDE, -1)
            images = images[:, : source.height, : source.width]
            stored = stored_texels(source, sources).to(table.dtype)
            if bool(stored.all()):
                write_planes(out, target, planes, _resize(images, target))
                continue
            there, value = _resize(stored, target), _resize(images * stored, target)
            value = torch.where(there > 1 - 1e-6, value, value / there.clamp(min=1e-12))
            write_planes(out, target, planes, torch.where(there > 0, value, empty))
    return out


def _chunks(target: TexelGrid) -> Iterator[tuple[slice, slice]]:
    """Source and target planes, a few at a time. The cube's layers go together."""
    step = target.depth if target.is_cube else max(1, CHUNK // (target.height * target.width))
    for start in range(0, target.depth, step):
        planes = slice(start, min(start + step, target.depth))
        yield (slice(None) if target.is_cube else planes), planes


def stored_texels(grid: TexelGrid, planes: slice) -> Bool[Tensor, "P h w 1"]:
    """Mask of the stored texels of some planes."""
    wide = (grid.own_tiles[planes] > 0).repeat_interleave(SIDE, 1).repeat_interleave(SIDE, 2)
    return wide[:, : grid.height, : grid.width, None]


def _resize(images: Float[Tensor, "P h w C"], target: TexelGrid) -> Float[Tensor, "Q H W C"]:
    """Images of another size, corners on corners; the layers of a cube are resized as well."""
    if target.is_cube:
        size = (target.depth, target.height, target.width)
        out = interpolate(images.permute(3, 0, 1, 2)[None], size=size, mode="trilinear", align_corners=True)
        return out[0].permute(1, 2, 3, 0)
    size = (target.height, target.width)
    return interpolate(images.permute(0, 3, 1, 2), size=size, mode="bilinear", align_corners=True).permute(0, 2, 3, 1)


def bits_of(masks: Int[Tensor, "N"]) -> Int[Tensor, "N 32"]:
    """The bits of columns, lowest first."""
    return (masks[:, None] >> torch.arange(WORD)) & 1


def columns_from(stored: Tensor, first: int) -> tuple[Int[Tensor, "N 2"], Int[Tensor, "B 3"]]:
    """Columns of one MPI, and (plane, row, column) of its bricks in their order.

    Args:
        stored: bool [planes, down, across], mask of the occupied tiles.
        first: number of bricks of earlier MPIs.
    """
    planes, down, across = stored.shape
    padded = pad(stored, (0, 0, 0, 0, 0, -planes % WORD))
    bits = padded.view(-1, WORD, down, across).permute(0, 2, 3, 1).reshape(-1, WORD)
    masks = (bits.to(torch.int64) << torch.arange(WORD)).sum(-1)
    counts = bits.sum(-1)
    columns = torch.stack([torch.where(masks >= 2**31, masks - 2**32, masks), first + counts.cumsum(0) - counts], -1)
    column, bit = bits.nonzero().unbind(-1)
    word, place = column // (down * across), column % (down * across)
    return columns.to(torch.int32), torch.stack([word * WORD + bit, place // across, place % across], -1)
