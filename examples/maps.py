"""A map of cameras, points and MPIs, seen from above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from painting import font, rgb8
from PIL import Image, ImageDraw

from mmpi_ns.placement.observations import Array, Observations
from mmpi_ns.scene.plan import CubePlan, MPIPlan

FINER = 3
"""Drawn so many times larger, then averaged."""
DRAWN_PLANES = 14


@dataclass(frozen=True)
class Map:
    """From scene units to pixels of a picture from above, forward to the right and left up."""

    base: Array
    """Rows forward, right (world axes). [2, 3]"""
    middle: Array
    """Of the cameras, world axes. [3]"""
    low: Array
    """(forward, right) at the top left corner. [2]"""
    scale: float
    """Pixels in a scene unit."""
    size: tuple[int, int]
    """Width and height in pixels."""
    backdrop: Image.Image
    """Points and cameras."""

    @staticmethod
    def of(observations: Observations, width: int, height: int) -> Map:
        """A map that holds the cameras and what is near them."""
        axes = observations.mean_axes
        base, middle = np.stack([axes[2], axes[0]]), observations.centers.mean(0)
        cameras = (observations.centers - middle) @ base.T
        distance = np.linalg.norm(observations.points - middle, axis=-1)
        reach = 1.5 * max(float(np.ptp(cameras, axis=0).max()), 1e-6)
        points = (observations.points[distance < reach] - middle) @ base.T
        every = np.concatenate([cameras, np.percentile(points, [3, 97], axis=0)]) if len(points) else cameras
        low, high = every.min(0), every.max(0)
        margin = 0.06 * (high - low).max()
        low, high = low - margin, high + margin
        # A map is wide and flat: half of what lies aside may be cut off, cameras may not.
        aside = max(0.5 * float((high - low)[1]), 1.2 * float(np.ptp(cameras[:, 1])))
        scale = min(width / float((high - low)[0]), height / aside)
        low = (low + high) / 2 - np.array([width, height]) / scale / 2
        empty = Image.new("RGB", (width * FINER, height * FINER), (250, 250, 250))
        drawn = Map(base, middle, low, scale, (width, height), empty)
        draw = ImageDraw.Draw(empty)
        for x, y in drawn.pixels(points):
            draw.rectangle([x - 1, y - 1, x + 1, y + 1], fill=(190, 190, 190))
        for x, y in drawn.pixels(cameras):
            draw.ellipse([x - 5, y - 5, x + 5, y + 5], fill=(20, 20, 20))
        return drawn

    def pixels(self, places: Array) -> list[tuple[float, float]]:
        """Places [N, 2] (forward, right) as pixels of the large picture."""
        return [(x, y) for x, y in ((places - self.low) * self.scale * FINER).tolist()]

    def flat(self, points: Array) -> Array:
        """World points [N, 3] as (forward, right) [N, 2]."""
        return (points - self.middle) @ self.base.T

    def draw(
        self, heads: list[tuple[MPIPlan | CubePlan, tuple[float, float, float]]], marks: Array | None = None
    ) -> Image.Image:
        """The map with some MPIs: borders of the frustum, planes, a cross at the origin; and places with letters.

        Args:
            heads: what to draw, and in which colours.
            marks: world points to name A, B, ... [N, 3]
        """
        image = self.backdrop.copy()
        for head, color in heads:
            tint = Image.new("RGB", image.size, rgb8(color))
            mask = Image.new("L", image.size, 0)
            outline = self._cube(head) if isinstance(head, CubePlan) else self._frustum(head)
            ImageDraw.Draw(mask).polygon(self.pixels(outline), fill=45 if len(heads) == 1 else 18)
            image = Image.composite(tint, image, mask)
            self._draw_head(ImageDraw.Draw(image), head, outline, rgb8(color))
        if marks is not None:
            self._draw_marks(ImageDraw.Draw(image), marks)
        image = image.resize(self.size, Image.Resampling.LANCZOS)
        ImageDraw.Draw(image).rectangle([0, 0, image.width - 1, image.height - 1], outline=(200, 200, 200))
        return image

    def _draw_marks(self, draw: ImageDraw.ImageDraw, marks: Array) -> None:
        for k, (x, y) in enumerate(self.pixels(self.flat(marks))):
            draw.line([(x, y), (x, y + 30)], fill=(20, 20, 20), width=4)
            draw.ellipse([x - 18, y + 24, x + 18, y + 60], fill=(20, 20, 20))
            draw.text((x, y + 42), chr(ord("A") + k), fill="white", font=font(27, bold=True), anchor="mm")

    def _draw_head(self, draw: ImageDraw.ImageDraw, head: MPIPlan | CubePlan, outline: Array, color) -> None:
        draw.line(self.pixels(np.concatenate([outline, outline[:1]])), fill=color, width=3)
        if isinstance(head, CubePlan):
            return
        for depth in plane_depths(head):
            draw.line(self.pixels(self._across(head, depth)), fill=color, width=3)
        ((x, y),) = self.pixels(self.flat(np.asarray([head.origin])))
        for sign in (-1, 1):
            draw.line([(x - 11, y - 11 * sign), (x + 11, y + 11 * sign)], fill=color, width=6)

    def _across(self, mpi: MPIPlan, depth: float) -> Array:
        """[2, 2] the ends of a plane: the two corners that lie farthest apart on the map."""
        u0, u1, v0, v1 = mpi.extent
        corners = np.array([[u, v, 1.0] for u in (u0, u1) for v in (v0, v1)]) @ np.asarray(mpi.axes)
        places = self.flat(np.asarray(mpi.origin) + depth * corners)
        apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
        first, last = np.unravel_index(int(apart.argmax()), apart.shape)
        return places[[first, last]]

    def _frustum(self, mpi: MPIPlan) -> Array:
        end = min(mpi.far, mpi.near + 4 * max(self.size) / self.scale)
        return np.concatenate([self._across(mpi, mpi.near), self._across(mpi, end)[::-1]])

    def _cube(self, cube: CubePlan) -> Array:
        (x0, y0, z0), (x1, y1, _) = cube.lower, cube.upper
        return self.flat(np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]]))


def plane_depths(mpi: MPIPlan) -> list[float]:
    """Depths of some of an MPI's planes, evenly spaced in disparity as all are, without the last one."""
    shares = np.linspace(0, 1, min(DRAWN_PLANES, mpi.planes), endpoint=False)
    return (mpi.near / (1 - mpi.depth_share * shares)).tolist()
