"""Boxes, spheres and upright cylinders, a kit that collects them, and their first intersections with rays.

Float64, so that depth is exact. Rays come in packets that lie close together (tiles of an image): a packet is tested
only against the primitives whose bounding spheres touch the cone around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mmpi_scene.materials import ROW

Array = NDArray[np.float64]
Arrays = TypeVar("Arrays", bound=Any)
BOX, SPHERE, CYLINDER = 0, 1, 2
PACKET = 4096
"""Rays tested together."""
START = 1e-6
"""Hits nearer than this share of a metre are the surface that the ray starts on."""
Color = Sequence[float]
BEIGE, WHITE, GRAY = (0.86, 0.76, 0.6), (0.95, 0.94, 0.9), (0.5,) * 3
BROWN, GREEN, PALE_GREEN = (0.42, 0.26, 0.15), (0.2, 0.38, 0.12), (0.5, 0.62, 0.25)
WALLS: tuple[Color, ...] = (
    (0.84, 0.68, 0.48), (0.78, 0.44, 0.34), (0.9, 0.84, 0.7), (0.62, 0.66, 0.68),
    (0.86, 0.56, 0.36), (0.66, 0.4, 0.32), (0.72, 0.76, 0.62), (0.92, 0.76, 0.42),
)  # fmt: skip
PAINTS: tuple[Color, ...] = (
    (0.75, 0.12, 0.1), (0.14, 0.28, 0.58), (0.85, 0.85, 0.86), (0.2, 0.22, 0.24), (0.62, 0.64, 0.66), (0.16, 0.42, 0.3),
    (0.9, 0.7, 0.15),
)  # fmt: skip


@dataclass(frozen=True)
class Primitives:
    """P solids as arrays, sorted by the x of their centres. World axes: z up, metres."""

    kind: NDArray[np.int64]
    """[P] BOX, SPHERE or CYLINDER."""
    center: Array
    """[P, 3]"""
    half: Array
    """[P, 3] half extents along the solid's own axes; of others (radius, radius, radius or half height)."""
    yaw: Array
    """[P] turn about z, radians."""
    material: NDArray[np.int64]
    """[P] row of the table of materials."""
    colors: Array
    """[P, 3, 3] three colours that the material mixes."""
    offset: Array
    """[P, 2] where in the noise the surface starts, metres."""

    def __len__(self) -> int:
        return len(self.kind)

    @staticmethod
    def merged(*parts: Primitives) -> tuple[Primitives, NDArray[np.int64]]:
        """All parts as one, sorted, and the number of the part that each solid comes from. [P]"""
        every = Primitives(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Primitives)))
        order = np.argsort(every.center[:, 0], kind="stable")
        return take(every, order), np.repeat(np.arange(len(parts)), [len(p) for p in parts])[order]


def take(arrays: Arrays, rows: NDArray[Any]) -> Arrays:
    """Some rows of a dataclass of arrays."""
    return type(arrays)(*(getattr(arrays, f.name)[rows] for f in fields(arrays)))


def to_local(vectors: Array, yaw: Array) -> Array:
    """World vectors [..., 3] in axes turned by ``yaw`` about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.stack([c * x + s * y, c * y - s * x, np.broadcast_to(z, (c * x).shape)], -1)


def dot(a: Array, b: Array) -> Array:
    """Inner products [N] of vectors [N, 3] (summing over a short axis is slow in NumPy)."""
    return np.einsum("ij,ij->i", a, b)


class Tracer:
    """Tracer of first hits; solids farther than ``reach`` along a ray are ignored."""

    def __init__(self, primitives: Primitives, reach: float) -> None:
        self.primitives, self.reach, half = primitives, reach, primitives.half
        flat = np.hypot(half[:, 0], np.where(primitives.kind == BOX, half[:, 1], 0.0))
        self.radius = np.where(primitives.kind == SPHERE, half[:, 0], np.hypot(flat, half[:, 2]))
        """[P] of the bounding spheres."""
        self.widest = float(self.radius.max(initial=0.0))
        self.top = float((primitives.center[:, 2] + primitives.half[:, 2]).max(initial=0.0))
        """Height above which there is nothing."""

    def near(self, lowest: float, highest: float, distance: float | None = None) -> NDArray[np.int64]:
        """Primitives that a ray starting between two x can meet, by a search in the sorted centres."""
        margin = (self.reach if distance is None else distance) + self.widest
        x = self.primitives.center[:, 0]
        first, last = np.searchsorted(x, [lowest - margin, highest + margin])
        return np.arange(first, last)

    def __call__(
        self, origins: Array, directions: Array, limit: float | None = None
    ) -> tuple[Array, NDArray[np.int64]]:
        """Distance [R] to the first solid within reach, or ``limit`` if less (inf for none) and its row (-1), for rays
        from origins [R, 3] in unit directions [R, 3]."""
        distance, row = np.full(len(directions), np.inf), np.full(len(directions), -1)
        if not len(directions) or not len(self.primitives):
            return distance, row
        reach = self.reach if limit is None else min(limit, self.reach)
        near = self.near(origins[:, 0].min(), origins[:, 0].max(), reach)
        for start in range(0, len(directions), PACKET):
            s = slice(start, start + PACKET)
            distance[s], row[s] = self._packet(near, origins[s], directions[s], reach)
        return distance, row

    def _packet(
        self, rows: NDArray[np.int64], origins: Array, directions: Array, reach: float
    ) -> tuple[Array, NDArray[np.int64]]:
        """First hits of a packet among ``rows``; a packet with too many candidates is halved."""
        rows, size = self.in_cone(rows, origins, directions, reach), len(directions)
        if size > 256 and size * len(rows) > 100_000:
            halves = (slice(None, size // 2), slice(size // 2, None))
            hits = [self._packet(rows, origins[h], directions[h], reach) for h in halves]
            return np.concatenate([d for d, _ in hits]), np.concatenate([solids for _, solids in hits])
        nearest, first_solid = np.full(size, np.inf), np.full(size, -1)
        # Pairs in which a ray meets a solid's bounding sphere, sorted by ray.
        apex = origins[0]
        center, start = self.primitives.center[rows] - apex, origins - apex
        square = (self.radius[rows] * (1 + 1e-6) + 1e-6) ** 2
        along = directions @ center.T - dot(start, directions)[:, None]
        away = dot(center, center) + dot(start, start)[:, None]
        if start.any():
            away -= 2 * start @ center.T
        ray, column = np.nonzero((away - along**2 <= square) & ((along > 0) | (away <= square)))
        if not len(ray):
            return nearest, first_solid
        solid = rows[column]
        t, kind = np.empty(len(ray)), self.primitives.kind[solid]
        for k, distances in ((BOX, box_distance), (SPHERE, sphere_distance), (CYLINDER, cylinder_distance)):
            pairs = np.flatnonzero(kind == k)
            shape = (getattr(self.primitives, name)[solid[pairs]] for name in ("center", "half", "yaw"))
            t[pairs] = distances(origins[ray[pairs]], directions[ray[pairs]], *shape)
        t[t >= reach] = np.inf
        # The nearest of each ray is a minimum over a run of pairs.
        starts = np.flatnonzero(np.diff(ray, prepend=-1))
        nearest[ray[starts]] = np.minimum.reduceat(t, starts)
        first = np.flatnonzero((t == nearest[ray]) & np.isfinite(t))[::-1]
        first_solid[ray[first]] = solid[first]
        return nearest, first_solid

    def in_cone(self, rows: NDArray[np.int64], origins: Array, directions: Array, reach: float) -> NDArray[np.int64]:
        """The subset of ``rows`` that the rays of a packet may meet."""
        apex, axis = origins.mean(0), directions.mean(0)
        shift = origins - apex
        spread = np.sqrt(dot(shift, shift).max())
        length = np.linalg.norm(axis)
        cosine = float((directions @ axis).min() / length) if length > 1e-6 else -1.0
        offset, radius = self.primitives.center[rows] - apex, self.radius[rows] + spread
        distance = np.sqrt(dot(offset, offset))
        touching = distance <= radius
        along = offset @ axis / max(length, 1e-12) / np.maximum(distance, 1e-12)
        angle = np.arccos(np.clip(along, -1, 1)) - np.arcsin(np.minimum(radius / np.maximum(distance, 1e-12), 1))
        inside = angle <= np.arccos(np.clip(cosine, -1, 1)) + 1e-6
        return rows[touching | (inside & (distance - radius < reach))]


def box_distance(origins: Array, directions: Array, center: Array, half: Array, yaw: Array) -> Array:
    """Distance [R] at which rays [R, 3] enter a box, each its own (as in ``Primitives``: [R, 3], [R, 3] and [R]), inf
    where they miss it or start inside."""
    o, d = (origins - center).T, directions.T
    c, sn = np.cos(yaw), np.sin(yaw)
    enter, leave = np.full(len(directions), -np.inf), np.full(len(directions), np.inf)
    for axis, extent in enumerate(half.T):
        # Along the box's own axes; the third is the world's.
        start, step = (v[2] if axis == 2 else c * v[axis] + (sn if axis == 0 else -sn) * v[1 - axis] for v in (o, d))
        inverse = 1.0 / np.where(np.abs(step) < 1e-14, 1e-14, step)
        middle, reach = -start * inverse, extent * np.abs(inverse)
        enter, leave = np.maximum(enter, middle - reach), np.minimum(leave, middle + reach)
    return np.where((enter <= leave) & (enter > START), enter, np.inf)


def sphere_distance(origins: Array, directions: Array, center: Array, half: Array, yaw: Array) -> Array:
    """The same for spheres."""
    o = origins - center
    along = dot(o, directions)
    # From the nearest point of the ray: |o|^2 - along^2 would lose the digits of a far, small sphere.
    nearest = o - along[:, None] * directions
    aside = dot(nearest, nearest)
    inside = half[:, 0] ** 2 - aside
    t = -along - np.sqrt(np.maximum(inside, 0))
    return np.where((inside > 0) & (t > START), t, np.inf)


def cylinder_distance(origins: Array, directions: Array, center: Array, half: Array, yaw: Array) -> Array:
    """The same for upright cylinders."""
    o, d, (radius, _, half_height) = origins - center, directions, half.T
    flat = np.maximum(dot(d[:, :2], d[:, :2]), 1e-28)
    along = dot(o[:, :2], d[:, :2]) / flat
    nearest = o[:, :2] - along[:, None] * d[:, :2]
    aside = dot(nearest, nearest)
    root = np.sqrt(np.maximum(radius**2 - aside, 0) / flat)
    inverse = 1.0 / np.where(np.abs(d[:, 2]) < 1e-14, 1e-14, d[:, 2])
    middle, reach = -o[:, 2] * inverse, half_height * np.abs(inverse)
    enter, leave = np.maximum(-along - root, middle - reach), np.minimum(-along + root, middle + reach)
    return np.where((aside < radius**2) & (enter <= leave) & (enter > START), enter, np.inf)


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
