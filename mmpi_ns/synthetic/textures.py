"""Procedural textures, band-limited by the footprint of a pixel so that they do not alias far away.

Stripes, bricks and windows are pulse trains under a box filter, which has a closed form; noise is value noise of
several octaves in a tile with its box-filtered halves (a mip map). Float32: only colours come from here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
TEXELS, PERIOD = 512, 16.0
"""Texels of the noise tile and the metres it spans before it repeats."""


def pulse(x: Array, width: Array, start: float | Array, end: float | Array) -> Array:
    """Share of [x - width/2, x + width/2] covered by [start, end] of every unit interval."""

    def covered(x: Array) -> Array:
        whole = np.floor(x)
        return whole * (end - start) + np.clip(x - whole - start, 0, end - start)

    width = np.maximum(width, 1e-4)
    return (covered(x + width / 2) - covered(x - width / 2)) / width


def band(x: Array, width: Array, start: float | Array, end: float | Array) -> Array:
    """Share of [x - width/2, x + width/2] covered by [start, end], once."""
    width = np.maximum(width, 1e-4)
    return (np.clip(x + width / 2, start, end) - np.clip(x - width / 2, start, end)) / width


def cell_hash(i: Array, j: Array, salt: float | Array) -> Array:
    """A number in [0, 1) for each cell of a grid."""
    n = (
        i.astype(np.int64) * 73856093
        ^ j.astype(np.int64) * 19349663
        ^ np.asarray(salt * 977).astype(np.int64) * 83492791
    )
    n = (n ^ (n >> 13)) * 1274126177 & 0x7FFFFFFF
    return (((n ^ (n >> 16)) & 0xFFFF) / 65536.0).astype(np.float32)


def rgb(*color: float) -> Array:
    """A colour [3]."""
    return np.array(color, np.float32)


def mix(a: Array, b: Array, share: Array) -> Array:
    """Colours [..., 3]: a where share [...] is 0, b where it is 1."""
    return a + (b - a) * share[..., None]


class Noise:
    """Value noise of seven octaves in a periodic tile."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng([seed, 77])
        tile = np.zeros((TEXELS, TEXELS))
        for octave in range(7):
            n = 4 << octave
            cells, x = random.uniform(-1, 1, (n, n)), (np.arange(TEXELS) + 0.5) * n / TEXELS - 0.5
            i = np.floor(x).astype(int)
            f = x - i
            f = f * f * (3 - 2 * f)
            rows = cells[i % n] * (1 - f)[:, None] + cells[(i + 1) % n] * f[:, None]
            tile += 0.62**octave * (rows[:, i % n] * (1 - f) + rows[:, (i + 1) % n] * f)
        levels = [(tile / tile.std() / 2).astype(np.float32)]
        while levels[-1].shape[0] > 1:
            t = levels[-1]
            levels.append((t[::2, ::2] + t[1::2, ::2] + t[::2, 1::2] + t[1::2, 1::2]) / 4)
        self.flat = np.concatenate([t.reshape(-1) for t in levels])
        self.start = np.cumsum([0, *(t.size for t in levels)])[:-1].astype(np.int32)

    def __call__(self, u: NDArray[Any], v: NDArray[Any], width: NDArray[Any]) -> Array:
        """Noise of mean 0 and standard deviation 0.5 at (u, v) metres, averaged over ``width`` metres."""
        level = np.log2(np.maximum(width * (TEXELS / PERIOD), 1.0)).clip(0, len(self.start) - 1.001)
        lower = level.astype(np.int32)
        a, b = self._bilinear(u, v, lower), self._bilinear(u, v, lower + 1)
        return (a + (b - a) * (level - lower)).astype(np.float32)

    def _bilinear(self, u: NDArray[Any], v: NDArray[Any], level: NDArray[np.int32]) -> Array:
        side = np.right_shift(TEXELS, level).astype(np.int32)
        per_metre = side.astype(np.float32) / PERIOD
        x, y = u * per_metre - 0.5, v * per_metre - 0.5
        i, j = np.floor(x), np.floor(y)
        x, y = x - i, y - j
        i, j = i.astype(np.int32) & (side - 1), j.astype(np.int32) & (side - 1)
        right, start = (i + 1) & (side - 1), self.start[level]
        row, below = start + j * side, start + ((j + 1) & (side - 1)) * side
        top = self.flat[row + i] * (1 - x) + self.flat[row + right] * x
        bottom = self.flat[below + i] * (1 - x) + self.flat[below + right] * x
        return (top + (bottom - top) * y).astype(np.float32)
