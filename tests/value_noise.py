"""Random texture for rendered walls."""

from __future__ import annotations

import numpy as np


def noise(u, v, table, octaves):
    """Smooth random texture at (u, v), in [0, 1].

    Args:
        u, v: places on the surface.
        table: random numbers, a square for each octave, repeated without end. [octaves, n, n]
        octaves: (squares per unit, weight) of each.
    """
    total, size = 0.0, table.shape[-1]
    for t, (scale, weight) in zip(table, octaves, strict=True):
        i, j = np.floor(u * scale).astype(int), np.floor(v * scale).astype(int)
        a, b = u * scale - i, v * scale - j
        a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
        parts = [
            t[(i + di) % size, (j + dj) % size] * (a if di else 1 - a) * (b if dj else 1 - b)
            for di in (0, 1)
            for dj in (0, 1)
        ]
        total = total + weight * sum(parts)
    return total
