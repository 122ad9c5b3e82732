"""Columns: bits of the occupied ones of ``WORD`` consecutive planes of a tile, so that a ray skips the others."""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

WORD = 32
"""Planes of a column."""


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
    padded = torch.nn.functional.pad(stored, (0, 0, 0, 0, 0, -planes % WORD))
    bits = padded.view(-1, WORD, down, across).permute(0, 2, 3, 1).reshape(-1, WORD)
    masks = (bits.to(torch.int64) << torch.arange(WORD)).sum(-1)
    counts = bits.sum(-1)
    columns = torch.stack([torch.where(masks >= 2**31, masks - 2**32, masks), first + counts.cumsum(0) - counts], -1)
    column, bit = bits.nonzero().unbind(-1)
    word, place = column // (down * across), column % (down * across)
    return columns.to(torch.int32), torch.stack([word * WORD + bit, place // across, place % across], -1)
