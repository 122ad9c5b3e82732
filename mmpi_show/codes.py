"""Stored form of the codes of bricks: differences from neighbouring codes, which gzip compresses well.

Every second row and column of a brick is stored first: with these, a page renders the brick at half of its resolution.
Nothing is stored twice. ``reader.py`` joins them again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from mmpi_show.reader import take_borders
from mmpi_show.scene import CELLS, SIDE

COARSE = np.zeros((SIDE, SIDE), bool)
"""Texels that are stored first."""
COARSE[::2, ::2] = True


def smoothed_codes(
    codes: UInt8[Tensor, "B 8 8"], slack: UInt8[Tensor, "B 8 8"], beside: Int[np.ndarray, "2 B"]
) -> UInt8[Tensor, "B 8 8"]:
    """Codes of a channel that take fewer bytes: those whose stored differences are at most their slack are replaced by
    the prediction from their neighbours, so that 0 is stored.

    Args:
        codes: of all bricks.
        slack: maximum error of each code. The first one of a brick is exact.
        beside: the bricks right of each brick and below it, -1 for none.
    """
    exact, most_off = codes.numpy().astype(np.int16), slack.numpy()
    smooth = np.zeros((len(codes), SIDE + 2, SIDE + 2), np.int16)  # two rows and columns of 0 lie before the brick
    inside = smooth[:, 2:, 2:]

    def settle(at: tuple[Any, ...], expected: NDArray[np.int16]) -> None:
        inside[at] = np.where(np.abs(exact[at] - expected) > most_off[at], exact[at], expected.clip(0, 255))

    inside[:, 0, 0] = exact[:, 0, 0]
    for y, x in np.argwhere(COARSE)[1:]:
        settle(np.s_[:, y, x], smooth[:, y + 2, x] + smooth[:, y, x + 2] - smooth[:, y, x])
    settle(np.s_[:, ::2, 1::2], _means(inside[:, ::2, ::2], 2))
    settle(np.s_[:, 1::2], _means(inside[:, ::2], 1))
    joined = inside.astype(np.uint8)
    take_borders(joined, beside)
    return torch.from_numpy(joined)


def split_codes(
    codes: UInt8[Tensor, "B 8 8"], beside: Int[np.ndarray, "2 B"]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Coarse codes [B, 4, 4], and the stored form of the others [48, B]: differences, modulo 256, from the means of
    those beside them; 0 for border texels that a neighbour also contains.

    Args:
        codes: of all bricks.
        beside: the bricks right of each brick and below it, -1 for none.
    """
    fine, (right, below) = codes.numpy().copy(), beside >= 0
    coarse = fine[:, ::2, ::2].copy()
    fine[:, 1::2] -= _means(fine[:, ::2], 1)
    fine[:, ::2, 1::2] -= _means(coarse, 2)
    fine[right, :, CELLS] = fine[below, CELLS] = 0
    return coarse, fine[:, ~COARSE].T


def coarse_differences(coarse: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Coarse codes [C, B, 4, 4] as they are stored [C, 16, B]: differences along rows and columns, and along bricks for
    the first texels."""
    stored = np.diff(np.diff(coarse, axis=3, prepend=np.uint8(0)), axis=2, prepend=np.uint8(0))
    stored[:, :, 0, 0] = np.diff(stored[:, :, 0, 0], prepend=np.uint8(0))
    return stored.reshape(*coarse.shape[:2], (SIDE // 2) ** 2).swapaxes(1, 2)


def _means(codes: NDArray[Any], axis: int) -> NDArray[Any]:
    """Means, rounded down, of codes and those after them along an axis; the last ones have none after them."""
    after = np.concatenate([np.delete(codes, 0, axis), np.take(codes, [-1], axis)], axis)
    return ((codes.astype(np.uint16) + after) >> 1).astype(codes.dtype)
