"""Codes of a channel as they are stored: every second row and column of a brick, and the others apart from them.

A page that has the first shows a brick at half of its resolution; nothing is stored twice.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.scene.baked import CELLS, SIDE, take_borders

COARSE = np.zeros((SIDE, SIDE), bool)
"""Texels that are stored first."""
COARSE[::2, ::2] = True


def split_codes(
    codes: UInt8[Tensor, "B 8 8"], beside: Int[Tensor, "2 B"]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Coarse codes [B, 4, 4], and the stored form of the others [48, B]: differences, modulo 256, from the means of
    those beside them; 0 for border texels that a neighbour also contains.

    Args:
        codes: of all bricks.
        beside: the bricks right of each brick and below it, -1 for none.
    """
    fine, (right, below) = codes.numpy().copy(), (beside >= 0).numpy()
    coarse = fine[:, ::2, ::2].copy()
    fine[:, 1::2] -= _means(fine[:, ::2], 1)
    fine[:, ::2, 1::2] -= _means(coarse, 2)
    fine[right, :, CELLS] = fine[below, CELLS] = 0
    return coarse, fine[:, ~COARSE].T


def coarse_differences(coarse: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Stored form [16, B] of coarse codes [B, 4, 4]: differences along rows and columns, and of first texels along
    bricks."""
    stored = np.diff(np.diff(coarse, axis=2, prepend=np.uint8(0)), axis=1, prepend=np.uint8(0))
    stored[:, 0, 0] = np.diff(stored[:, 0, 0], prepend=np.uint8(0))
    return stored.reshape(len(coarse), -1).T


def coarse_codes(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Coarse codes [B, 4, 4] from their stored form [16, B]."""
    codes = stored.T.reshape(-1, SIDE // 2, SIDE // 2).copy()
    codes[:, 0, 0] = np.cumsum(codes[:, 0, 0], dtype=np.uint8)
    return codes.cumsum(1, dtype=np.uint8).cumsum(2, dtype=np.uint8)


def joined_codes(
    coarse: NDArray[np.uint8], fine: NDArray[np.uint8], beside: Int[Tensor, "2 B"]
) -> UInt8[Tensor, "B 8 8"]:
    """The codes that ``split_codes`` split."""
    codes = np.empty((len(coarse), SIDE, SIDE), np.uint8)
    codes[:, ::2, ::2], codes[:, ~COARSE] = coarse, fine.T
    codes[:, ::2, 1::2] += _means(coarse, 2)
    codes[:, 1::2] += _means(codes[:, ::2], 1)
    joined = torch.from_numpy(codes)
    take_borders(joined, beside)
    return joined


def _means(codes: NDArray[np.uint8], axis: int) -> NDArray[np.uint8]:
    """Means, rounded down, of codes and those after them along an axis; the last ones have none after them."""
    after = np.concatenate([np.delete(codes, 0, axis), np.take(codes, [-1], axis)], axis)
    return ((codes.astype(np.uint16) + after) >> 1).astype(np.uint8)
