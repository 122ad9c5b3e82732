"""A scene: solids, a ground plane, a sky at infinity, a light and cameras. Colour and distance of any ray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mmpi_scene.cameras import Cameras
from mmpi_scene.materials import MATERIALS, Noise, Surface
from mmpi_scene.primitives import CYLINDER, PACKET, SPHERE, Array, Primitives, Tracer, dot, take, to_local
from mmpi_scene.road import Road

Colors = NDArray[np.float32]
Ground = Callable[[Array, Array, Array, Noise], Colors]
"""Colours [N, 3] of points [N, 2] on z = 0, seen along unit directions [N, 3] with pixels [N] metres wide."""
Sky = Callable[[Array, float, Noise], Colors]
"""Colours [N, 3] of unit directions [N, 3], for pixels of a width in radians."""
TILE = 64
"""Side of the image tiles whose rays are traced together, pixels."""


@dataclass(frozen=True)
class Light:
    """A sun or a lamp, and ambient light."""

    toward: tuple[float, float, float]
    """Direction of the sun, or place of the lamp."""
    is_lamp: bool = False
    strength: float = 0.55
    ambient: float = 0.55
    casts_shadows: bool = True


@dataclass(frozen=True)
class Scene:
    """A procedural scene. World axes: z up; the ground is z = 0; metres."""

    name: str
    seed: int
    primitives: Primitives
    ground: Ground
    sky: Sky
    light: Light
    cameras: Cameras
    reach: float = 300.0
    """Solids farther from a ray's origin do not count, so the cost of an image does not grow with the scene."""
    track_range: float = 60.0
    """SfM points are matched no farther away than this."""
    road: Road | None = None
    """The road of a street; None for other scenes."""
    movers: Callable[[int], Primitives] | None = None
    """Moving objects at the time of an image."""
    moving: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """[P] mask of the solids that are moving objects; empty: none."""
    noise: Noise = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", Noise(self.seed))

    def filmed_by(self, camera: int) -> Scene:
        """The scene at the time of an image: with its moving objects, unless the image is held out."""
        if self.movers is None or self.cameras.is_test[camera]:
            return self if self.movers is None else replace(self, movers=None)
        primitives, part = Primitives.merged(self.primitives, self.movers(camera))
        return replace(self, primitives=primitives, moving=part == 1)

    @cached_property
    def tracer(self) -> Tracer:
        return Tracer(self.primitives, self.reach)

    def hit(self, origins: Array, directions: Array) -> tuple[Array, NDArray[np.int64]]:
        """Distance [R] (inf: the sky) and row of the primitive that is hit [R], -1 for ground and sky."""
        distance, row = self.tracer(origins, directions)
        down = directions[:, 2]
        ground = np.where(down < -1e-9, -origins[:, 2] / np.where(down < -1e-9, down, -1.0), np.inf)
        below = (ground > 1e-6) & (ground < distance)
        return np.where(below, ground, distance), np.where(below, -1, row)

    def trace(self, origins: Array, directions: Array, pixel: float = 0.0) -> tuple[Array, Colors]:
        """Distance [R] of the first hit of each ray [R, 3], inf for the sky, and its colour [R, 3] in [0, 1], averaged
        over the angle ``pixel`` of a ray, radians."""
        distance, colors = np.empty(len(directions)), np.empty((len(directions), 3), np.float32)
        for start in range(0, len(directions), PACKET):
            s = slice(start, start + PACKET)
            distance[s], row = self.hit(origins[s], directions[s])
            colors[s] = self.shade(origins[s], directions[s], distance[s], row, pixel)[0]
        return distance, colors

    def shade(
        self, origins: Array, directions: Array, distance: Array, row: NDArray, pixel: float
    ) -> tuple[Colors, NDArray]:
        """Colours [R, 3] in [0, 1] of hits, and a number [R] for each lit or shaded face; ``pixel`` as in ``trace``."""
        finite = np.isfinite(distance)
        colors = np.empty((len(directions), 3), np.float32)
        if not finite.all():
            colors[~finite] = self.sky(directions[~finite], pixel, self.noise)
        points = origins + np.where(finite, distance, 0)[:, None] * directions
        normals = np.broadcast_to(np.array([0.0, 0.0, 1.0]), points.shape).copy()
        floor, solid = finite & (row < 0), row >= 0
        patch = 8 * row + 2 * finite
        if floor.any():
            colors[floor] = self.ground(points[floor, :2], directions[floor], distance[floor] * pixel, self.noise)
        if solid.any():
            solids = take(self.primitives, row[solid])
            surface, normals[solid] = surface_of(solids, points[solid], directions[solid], distance[solid] * pixel)
            for number, material in enumerate(MATERIALS.values()):
                rows = solids.material == number
                if rows.any():
                    colors[np.flatnonzero(solid)[rows]] = material(take(surface, rows), self.noise)
            patch[solid] = 8 * row[solid] + 2 * surface.side
        light, in_sun = self._lit(points[finite], normals[finite])
        colors[finite] *= light[:, None]
        patch[finite] += in_sun
        return colors.clip(0, 1), patch

    def _lit(self, points: Array, normals: Array) -> tuple[Colors, NDArray[np.bool_]]:
        """Light [N] that falls on points [N, 3], and whether the sun or lamp reaches them [N]."""
        light = self.light
        toward = np.array(light.toward) - (points if light.is_lamp else 0.0) + np.zeros_like(points)
        far = np.sqrt(dot(toward, toward))
        toward /= far[:, None]
        cosine = dot(normals, toward)
        in_light = cosine > 1e-3
        if light.casts_shadows and in_light.any():
            starts, toward, far = (points + 1e-4 * normals)[in_light], toward[in_light], far[in_light]
            limit = float(far.max())
            if not light.is_lamp:
                far, limit = np.full_like(far, np.inf), max(self.tracer.top / max(float(toward[0, 2]), 0.05), 1e-3)
            # Neighbours in space go into one packet.
            order = np.argsort(starts[:, np.argmax(np.ptp(starts, axis=0))], kind="stable")
            visible = np.empty(len(starts), bool)
            visible[order] = self.tracer(starts[order], toward[order], limit)[0] >= far[order] * (1 - 1e-6)
            in_light[in_light] = visible
        direct = np.where(in_light, cosine, 0) * light.strength
        return (light.ambient * (0.85 + 0.15 * normals[:, 2]) + direct).astype(np.float32), in_light


def surface_of(these: Primitives, points: Array, directions: Array, pixel: Array) -> tuple[Surface, Array]:
    """Coordinates on the faces of the solids hit, and the normals [N, 3] there, of points on them [N, 3], the rays that
    met them [N, 3], and the width of a pixel at each, across the ray. [N] metres"""
    n = np.arange(len(points))
    q, d = to_local(points - these.center, these.yaw), to_local(directions, these.yaw)
    h = these.half
    # How far outside each pair of faces: the face hit is the one where the point is on the border.
    side = np.argmax(np.abs(q) - h, -1)
    curved = (these.kind == SPHERE) | ((these.kind == CYLINDER) & (np.abs(q[:, 2]) < h[:, 2] * (1 - 1e-9)))
    side = np.where(these.kind == CYLINDER, 2, side)
    normal = np.zeros_like(q)
    normal[n, side] = np.sign(q[n, side])
    radial = q / h[:, :1] * np.where(these.kind == CYLINDER, [[1.0], [1.0], [0.0]], 1.0).T
    normal[curved] = radial[curved]
    a, b = np.where(side == 0, 1, 0), np.where(side == 2, 1, 2)
    u, v, width, height = q[n, a] + h[n, a], q[n, b] + h[n, b], 2 * h[n, a], 2 * h[n, b]
    across = np.abs(d[n, side])
    du, dv = (pixel * np.hypot(1, d[n, k] / np.maximum(across, 0.01)) for k in (a, b))
    if curved.any():
        # Sixteen metres of noise go round a whole number of times, so that there is no seam.
        turns = np.maximum(np.round(2 * np.pi * h[:, 0] / 16.0), 1)
        scale = 16.0 * turns / (2 * np.pi * h[:, 0])
        up = np.where(these.kind == SPHERE, np.arccos(np.clip(-radial[:, 2], -1, 1)) * h[:, 0], q[:, 2] + h[:, 2])
        cosine = np.maximum(np.abs(dot(normal, d)), 0.1)
        round_ = np.arctan2(q[:, 1], q[:, 0]) / (2 * np.pi) * 16.0 * turns
        u, v = np.where(curved, round_, u), np.where(curved, up * scale, v)
        du, dv = (np.where(curved, pixel * scale / cosine, x) for x in (du, dv))
        width, height = np.where(curved, 16.0 * turns, width), np.where(curved, 2 * h[:, 2] * scale, height)
    u, v, du, dv, width, height = (x.astype(np.float32) for x in (u, v, du, dv, width, height))
    colors, offset = these.colors.astype(np.float32), these.offset.astype(np.float32)
    surface = Surface(u, v, du, dv, width, height, np.where(curved, 3, side).astype(np.int8), colors, offset)
    return surface, to_local(normal, -these.yaw)


def render(scene: Scene, camera: int, supersample: int = 2, contrast: float = 0.25) -> tuple[Colors, Colors]:
    """One image [H, W, 3] in [0, 1] and the exact distance [H, W] along the pixels' central rays, inf for the sky.

    Textures are averaged over the pixel, so one ray shows the inside of a face; pixels that differ from a neighbour
    (another face, a shadow, another colour by ``contrast``, 0 for all) have ``supersample`` rays along each side.
    """
    cameras = scene.cameras
    h, w = cameras.height, cameras.width
    colors, depths, patch = np.empty((h * w, 3), np.float32), np.empty(h * w), np.empty(h * w, np.int64)
    order = tile_order(h, w)
    for start in range(0, h * w, PACKET):
        these = order[start : start + PACKET]
        rays = cameras.rays_at(camera, cameras.central_tangents[these])
        depths[these], row = scene.hit(*rays)
        colors[these], patch[these] = scene.shade(*rays, depths[these], row, 1 / cameras.focal)
    differs = np.full((h, w), contrast <= 0)  # from one of its neighbours
    for axis in (0, 1):
        color_change = np.abs(np.diff(colors.reshape(h, w, 3), axis=axis)).max(-1) > contrast
        change = color_change | (np.diff(patch.reshape(h, w), axis=axis) != 0)
        for sides in ((1, 0), (0, 1)):
            differs |= np.pad(change, [sides if k == axis else (0, 0) for k in (0, 1)])
    edges = order[differs.reshape(-1)[order]]
    inner = (np.arange(supersample) + 0.5) / supersample - 0.5
    shifts: Array = np.stack(np.meshgrid(inner, inner), -1).reshape(-1, 2)
    per_packet = max(PACKET // len(shifts), 1)
    for start in range(0, len(edges), per_packet):
        these = edges[start : start + per_packet]
        rays = cameras.rays(camera, (cameras.pixel_centers[these][:, None] + shifts).reshape(-1, 2))
        samples = scene.trace(*rays, pixel=1 / (cameras.focal * supersample))[1]
        colors[these] = samples.reshape(len(these), -1, 3).mean(1)
    return colors.reshape(h, w, 3), depths.reshape(h, w).astype(np.float32)


def tile_order(height: int, width: int) -> NDArray[np.int64]:
    """Flat pixel indices tile by tile, so that packets of rays lie close together."""
    y, x = np.divmod(np.arange(height * width), width)
    return np.lexsort((x, y, x // TILE, y // TILE))
