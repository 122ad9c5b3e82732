"""Collects solids for a scene, and poses for its cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mmpi_ns.synthetic.materials import ROW
from mmpi_ns.synthetic.primitives import BOX, CYLINDER, SPHERE, Array, Primitives

Color = Sequence[float]
BEIGE, WHITE, BROWN, GREEN, GRAY = (
    (0.86, 0.76, 0.6),
    (0.95, 0.94, 0.9),
    (0.42, 0.26, 0.15),
    (0.2, 0.38, 0.12),
    (0.5,) * 3,
)
PALE_GREEN = (0.5, 0.62, 0.25)
WALLS: tuple[Color, ...] = (
    (0.84, 0.68, 0.48), (0.78, 0.44, 0.34), (0.9, 0.84, 0.7), (0.62, 0.66, 0.68),
    (0.86, 0.56, 0.36), (0.66, 0.4, 0.32), (0.72, 0.76, 0.62), (0.92, 0.76, 0.42),
)  # fmt: skip
PAINTS: tuple[Color, ...] = (
    (0.75, 0.12, 0.1), (0.14, 0.28, 0.58), (0.85, 0.85, 0.86), (0.2, 0.22, 0.24), (0.62, 0.64, 0.66), (0.16, 0.42, 0.3),
    (0.9, 0.7, 0.15),
)  # fmt: skip


class Kit:
    """Solids added one by one; all randomness comes from the kit's generator."""

    def __init__(self, seed: int, topic: int) -> None:
        self.random = np.random.default_rng([seed, topic])
        self.rows: list[tuple] = []

    def _add(self, kind: int, center: Color, half: Color, yaw: float, material: str, colors: Sequence[Color]) -> None:
        three = (*colors, *([colors[-1]] * (3 - len(colors))))
        self.rows.append((kind, center, half, yaw, ROW[material], three, self.random.uniform(0, 16, 2)))

    def box(self, center: Color, size: Color, material: str, *colors: Color, yaw: float = 0.0) -> None:
        """A box by its centre and full size, turned by ``yaw`` about its upright axis."""
        self._add(BOX, center, [s / 2 for s in size], yaw, material, colors)

    def standing(self, place: Color, size: Color, material: str, *colors: Color, yaw: float = 0.0) -> None:
        """A box by the middle of its bottom."""
        self.box((place[0], place[1], place[2] + size[2] / 2), size, material, *colors, yaw=yaw)

    def sphere(self, center: Color, radius: float, material: str, *colors: Color) -> None:
        self._add(SPHERE, center, (radius,) * 3, 0.0, material, colors)

    def cylinder(self, place: Color, radius: float, height: float, material: str, *colors: Color) -> None:
        """An upright cylinder by the middle of its bottom."""
        center = (place[0], place[1], place[2] + height / 2)
        self._add(CYLINDER, center, (radius, radius, height / 2), 0.0, material, colors)

    def varied(self, color: Color, by: float = 0.07) -> Color:
        """A colour near another."""
        return tuple((np.array(color) * (1 + self.random.uniform(-by, by, 3))).clip(0, 1))

    def pick(self, colors: Sequence[Color]) -> Color:
        return self.varied(colors[self.random.integers(len(colors))])

    def done(self) -> Primitives:
        """All solids."""
        kind, center, half, yaw, material, colors, offset = zip(*self.rows, strict=True)
        return Primitives.merged(Primitives(
            np.array(kind), np.array(center, float), np.array(half, float), np.array(yaw, float),
            np.array(material), np.array(colors, float), np.array(offset, float),
        ))[0]  # fmt: skip


def look(places: Array, yaw: Array, pitch: Array) -> Array:
    """Poses [M, 3, 4] (OpenGL axes) at places [M, 3], facing ``yaw`` about z from +x and ``pitch`` upwards."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    right = np.stack([sy, -cy, np.zeros_like(yaw)], -1)
    back = np.stack([-cp * cy, -cp * sy, -sp], -1)
    up = np.cross(back, right)
    return np.asarray(np.stack([right, up, back, places], -1), dtype=np.float64)
