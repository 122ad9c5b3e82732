"""Textures of solids: each material maps surface coordinates to a colour.

All are band-limited by the footprint of a pixel, so that they do not alias far away. Stripes, bricks and windows are
pulse trains under a box filter, which has a closed form; noise is value noise of several octaves in a tile with its
box-filtered halves (a mip map). Float32: only colours come from here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
TEXELS, PERIOD = 512, 16.0
"""Texels of the noise tile and the metres it spans before it repeats."""


def pulse(x: Array, width: Array, start: float | Array, end: float | Array) -> Array:
    """Share of [x - width/2, x + width/2] covered by [start, end] of every unit interval."""
    width, length = np.maximum(width, 1e-4), end - start
    ends = ((end, np.floor(end)) for end in (x + width / 2, x - width / 2))
    after, before = (whole * length + np.clip(end - whole - start, 0, length) for end, whole in ends)
    return (after - before) / width


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


@dataclass(frozen=True)
class Surface:
    """N points on faces, in metres along the face."""

    u: Array
    """[N] along the face (round the solid, on spheres and cylinders)."""
    v: Array
    """[N] up the face (across it, on tops and bottoms)."""
    du: Array
    """[N] width of the pixel's footprint along u."""
    dv: Array
    """[N] and along v."""
    width: Array
    """[N] of the face."""
    height: Array
    """[N] of the face."""
    side: NDArray[np.int8]
    """[N] 0 and 1: across the solid's x and y; 2: top or bottom; 3: curved."""
    colors: Array
    """[N, 3, 3] of the solid."""
    offset: Array
    """[N, 2] of the solid's noise."""

    def noise(self, noise: Noise, scale: float | Array = 1.0, stretch: float = 1.0) -> Array:
        """[N] noise, finer by ``scale``, and by ``stretch`` along u."""
        width = np.maximum(np.sqrt(self.du * self.dv), np.maximum(self.du, self.dv) / 3) * scale
        return noise(self.u * scale * stretch + self.offset[:, 0], self.v * scale + self.offset[:, 1], width)


Material = Callable[[Surface, Noise], Array]


def plaster(s: Surface, noise: Noise) -> Array:
    """One colour, stained: concrete, cloth, ceilings."""
    color = mix(s.colors[:, 0], s.colors[:, 1], 0.5 + 0.8 * s.noise(noise, 1.7))
    return color * (1 + 0.16 * s.noise(noise, 0.3))[:, None]


def foliage(s: Surface, noise: Noise) -> Array:
    """Leaves: strong fine noise."""
    fine, coarse = s.noise(noise, 2.0), s.noise(noise, 0.5)
    return mix(s.colors[:, 0], s.colors[:, 1], np.clip(0.5 + 0.9 * fine + 0.4 * coarse, 0, 1.4))


def wood(s: Surface, noise: Noise) -> Array:
    """Planks along u with a grain."""
    plank = s.v / 0.16
    seam = pulse(plank, s.dv / 0.16, 0.0, 0.06)
    tone = cell_hash(np.floor(plank), np.zeros_like(plank), s.offset[:, 0]) - 0.5
    grain = s.noise(noise, 3.0, stretch=0.12)
    color = mix(s.colors[:, 0], s.colors[:, 1], 0.5 + 0.7 * grain + 0.5 * tone)
    return mix(color, 0.35 * color, seam)


def checker(s: Surface, noise: Noise) -> Array:
    """Squares of the width of colours 0 and 1, 0.35 m at most, under noise."""
    cell = np.minimum(0.35, s.width / 4)
    a, b = (pulse(x / (2 * cell), d / (2 * cell), 0.0, 0.5) for x, d in ((s.u, s.du), (s.v, s.dv)))
    color = mix(s.colors[:, 0], s.colors[:, 1], a + b - 2 * a * b)
    return color * (1 + 0.22 * s.noise(noise, 2.0))[:, None]


def stripes(s: Surface, noise: Noise) -> Array:
    """Upright stripes of three colours."""
    x, d = s.u / 0.3, s.du / 0.3
    color = mix(s.colors[:, 0], s.colors[:, 1], pulse(x, d, 0.3, 0.62))
    color = mix(color, s.colors[:, 2], pulse(x, d, 0.7, 0.8))
    return color * (1 + 0.2 * s.noise(noise, 2.0))[:, None]


def bricks(s: Surface, noise: Noise, length: float = 0.5, height: float = 0.25) -> Array:
    """Bricks in bond, mortar of colour 2."""
    row = np.floor(s.v / height)
    x = s.u / length + 0.5 * (row % 2)
    joint = np.maximum(pulse(x, s.du / length, 0.0, 0.05), pulse(s.v / height, s.dv / height, 0.0, 0.1))
    fade = 1 / (1 + (s.du / length) ** 2 + (s.dv / height) ** 2)
    tone = (cell_hash(np.floor(x), row, s.offset[:, 0]) - 0.5) * fade
    color = mix(s.colors[:, 0], s.colors[:, 1], 0.5 + 0.9 * tone + 0.5 * s.noise(noise, 1.0))
    return mix(color, s.colors[:, 2], joint)


def facade(s: Surface, noise: Noise) -> Array:
    """A house front: wall of colours 0 and 1, trim of colour 2, storeys of windows, doors below."""
    across = np.maximum(np.round(s.width / 2.7), 1)
    x, dx = s.u / s.width * across, s.du / s.width * across
    storeys = np.maximum(np.round(s.height / 3.1), 1)
    y, dy = s.v / s.height * storeys, s.dv / s.height * storeys
    column, floor = np.floor(x), np.floor(y)
    is_door = (floor < 0.5) & (cell_hash(column, floor, s.offset[:, 1]) < 0.35)
    bottom, top = np.where(is_door, 0.02, 0.3).astype(np.float32), np.where(is_door, 0.76, 0.8).astype(np.float32)
    side = np.where(is_door, 0.34, 0.27).astype(np.float32)
    stone = cell_hash(np.zeros_like(s.u), np.zeros_like(s.u), s.offset[:, 0]) < 0.5
    wall = np.where(stone[:, None], bricks(s, noise, 0.62, 0.31), plaster(s, noise))
    wall = mix(wall, s.colors[:, 2], band(s.v, s.dv, s.height - 0.35, s.height) * 0.8)
    wall = mix(wall, wall * 0.62, band(s.v, s.dv, 0.0, 0.55))
    wall = mix(wall, wall * 0.7, 0.6 * pulse(y, dy, 0.0, 0.045) * (floor > 0))
    frame = pulse(x, dx, side - 0.05, 0.95 - side + 0.1) * pulse(y, dy, np.maximum(bottom - 0.05, 0), top + 0.05)
    wall = mix(wall, s.colors[:, 2], frame)
    # Glass and door leaves in the frames.
    pane = pulse(x, dx, side, 1 - side) * pulse(y, dy, bottom, top)
    tone = cell_hash(np.floor(x), np.floor(y), s.offset[:, 0] + 3)
    share = np.clip(y - np.floor(y), 0, 1)
    glass = np.stack([0.13 + 0.22 * share, 0.17 + 0.27 * share, 0.22 + 0.32 * share], -1) * (0.6 + 0.8 * tone)[:, None]
    curtain = (tone > 0.6) * band(share, dy, 0.55, 1.0)
    glass = mix(glass, np.broadcast_to(rgb(0.78, 0.72, 0.62), glass.shape), curtain)
    leaf = s.colors[:, 2] * (0.25 + 0.5 * tone)[:, None] * (1 + 0.3 * s.noise(noise, 2.0, 3.0))[:, None]
    bars = np.maximum(pulse(x, dx, 0.48, 0.52), pulse(y, dy, 0.54, 0.57))
    inner = np.where(is_door[:, None], leaf, mix(glass, s.colors[:, 2], bars))
    return mix(wall, inner, pane)


def car(s: Surface, noise: Noise) -> Array:
    """Paint of colour 0, a bumper line, lights at the ends, door joints along the sides."""
    share = s.v / s.height
    paint = s.colors[:, 0] * (0.78 + 0.34 * share + 0.08 * s.noise(noise, 1.0))[:, None]
    upright = s.side < 2
    dark = paint * 0.25
    paint = mix(paint, dark, upright * band(share, s.dv / s.height, 0.0, 0.22))
    ends = (s.side == 0) * (band(s.u, s.du, 0.12, 0.45) + band(s.u, s.du, s.width - 0.45, s.width - 0.12))
    paint = mix(paint, s.colors[:, 2], ends * band(share, s.dv / s.height, 0.5, 0.8))
    plate = (s.side == 0) * band(s.u, s.du, s.width / 2 - 0.28, s.width / 2 + 0.28) * band(share, s.dv, 0.3, 0.45)
    paint = mix(paint, np.full_like(paint, 0.9), plate)
    joint = (s.side == 1) * pulse(s.u / 1.15, s.du / 1.15, 0.0, 0.03)
    return mix(paint, dark, joint)


def cabin(s: Surface, noise: Noise) -> Array:
    """The glass top of a car: panes between pillars, a painted roof."""
    pillars = np.where(s.side == 1, 1.05, s.width).astype(np.float32)
    glass = pulse(s.u / pillars, s.du / pillars, 0.05, 0.95) * band(s.v, s.dv, 0.04, s.height - 0.07) * (s.side < 2)
    share = (s.v / s.height)[:, None]
    pane = rgb(0.12, 0.16, 0.2) + rgb(0.22, 0.26, 0.3) * share
    pane = pane * (1 + 0.5 * s.noise(noise, 0.7))[:, None]
    return mix(s.colors[:, 0] * (1 + 0.08 * s.noise(noise, 1.0))[:, None], pane, glass)


def painting(s: Surface, noise: Noise) -> Array:
    """A picture in a frame of colour 2."""
    margin = 0.07
    inside = band(s.u, s.du, margin, s.width - margin) * band(s.v, s.dv, margin, s.height - margin)
    hill = 0.5 * s.height + 0.22 * s.height * s.noise(noise, 1.4, 1.0)
    ground = np.clip((hill - s.v) / np.maximum(s.dv, 0.02) + 0.5, 0, 1)
    canvas = mix(s.colors[:, 0], s.colors[:, 1], ground) * (1 + 0.45 * s.noise(noise, 5.0))[:, None]
    spot = np.hypot(s.u - 0.68 * s.width, s.v - 0.72 * s.height) / np.minimum(s.width, s.height)
    canvas = mix(canvas, np.broadcast_to(rgb(0.96, 0.82, 0.4), canvas.shape), np.clip((0.13 - spot) * 40, 0, 1))
    return mix(s.colors[:, 2] * (1 + 0.2 * s.noise(noise, 3.0))[:, None], canvas, inside)


def books(s: Surface, noise: Noise) -> Array:
    """Shelves of books; wood of colour 0 between them."""
    shelf, slot = s.v / 0.36, s.u / 0.055
    row, column = np.floor(shelf), np.floor(slot)
    kinds = np.stack([cell_hash(column, row, s.offset[:, 0] + k) for k in range(4)], -1)
    fade = 1 / (1 + (s.du / 0.055) ** 2)
    color = 0.38 + (kinds[:, :3] * 0.85 + 0.05 - 0.38) * fade[:, None]
    tops = 0.62 + 0.25 * kinds[:, 3] * fade
    filled = pulse(shelf, s.dv / 0.36, 0.1, tops) * (1 - 0.6 * pulse(slot, s.du / 0.055, 0.0, 0.12))
    color = mix(color, 1.25 * color, pulse(shelf, s.dv / 0.36, 0.45, 0.5))
    inner = mix(s.colors[:, 0] * 0.25, color, filled)
    boards = np.maximum(pulse(shelf, s.dv / 0.36, 0.0, 0.1), 1 - band(s.u, s.du, 0.04, s.width - 0.04))
    outer = mix(s.colors[:, 0], s.colors[:, 1], 0.5 + s.noise(noise, 2.0, 0.2))
    return np.where((s.side < 2)[:, None], mix(inner, outer, boards), outer)


MATERIALS: dict[str, Material] = {
    f.__name__: f for f in (plaster, foliage, wood, checker, stripes, bricks, facade, car, cabin, painting, books)
}
ROW = {name: i for i, name in enumerate(MATERIALS)}
