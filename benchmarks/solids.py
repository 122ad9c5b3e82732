"""A wall and a ball with smooth solid textures: exact depth and colour of any ray, and exact tables for any MPI."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from random_scenes import Array

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.scene.plan import MPIPlan, ScenePlan

STEEPNESS = 1e6
"""Raw density per unit of depth inside a solid: from empty to opaque within 1e-5 units, and affine, so that bilinear
interpolation moves the border of a flat solid nowhere."""
SKIN = 5e-5
"""A point so little outside counts as inside: a plane that lies in a surface is opaque."""
WAVES = np.array([[1.9, 0.7, 0.6], [-0.8, 2.1, 0.9], [1.3, -1.2, 1.1]])
"""Wave vectors of the three colours, radians per unit."""


@dataclass(frozen=True)
class Solids:
    """Everything behind the plane ``normal . p = offset``, and a ball; x right, y down, z ahead."""

    normal: tuple[float, float, float]
    offset: float
    ball: tuple[float, float, float, float] | None = None
    """Centre and radius."""

    def depth_inside(self, points: Array) -> Array:
        """How deep points [..., 3] lie inside (negative: outside)."""
        wall = points @ np.array(self.normal) - self.offset
        if self.ball is None:
            return wall
        return np.maximum(wall, self.ball[3] - np.linalg.norm(points - np.array(self.ball[:3]), axis=-1))

    def color(self, points: Array) -> Array:
        """Colour [..., 3] of the texture, which fills the solids."""
        return 0.5 + 0.35 * np.sin(points @ WAVES.T + np.array([0.0, 1.0, 2.0]))

    def hit(self, origins: Array, directions: Array) -> Array:
        """Distance [R] at which rays enter a solid."""
        normal = np.array(self.normal)
        t = (self.offset - origins @ normal) / (directions @ normal)
        if self.ball is None:
            return t
        toward = np.array(self.ball[:3]) - origins
        along = (toward * directions).sum(-1)
        gap = self.ball[3] ** 2 - (toward**2).sum(-1) + along**2
        enters = np.where(gap > 0, along - np.sqrt(np.maximum(gap, 0)), np.inf)
        return np.minimum(t, enters)


def bake(solids: Solids, mpis: list[MPIPlan]) -> MMPIField:
    """A field whose texels hold density and colour of the solids at the points where they lie. No training."""
    plan = ScenePlan(tuple(mpis), None, 0.05, 1.0)
    field = MMPIField(plan, feature_channels=3, hidden_width=4).eval()
    for mpi, grid in zip(mpis, field.grids, strict=True):
        u, v = np.linspace(*mpi.extent[:2], mpi.width), np.linspace(*mpi.extent[2:], mpi.height)
        rays = np.stack([*np.meshgrid(u, v), np.ones((mpi.height, mpi.width))], -1) @ np.array(mpi.axes)
        w = np.linspace(1 / mpi.near, 1 / mpi.far, mpi.planes)[:, None, None]
        # A plane at infinity lies inside a wall that goes on for ever; its texture means nothing there.
        depth = 1 / np.maximum(w, 1e-6)
        points = np.array(mpi.origin) + rays * depth[..., None]
        inside = np.clip(solids.depth_inside(points), -100, 100)
        color = solids.color(points)
        field.density.data[grid.rows, 0] = torch.tensor(STEEPNESS * (inside + SKIN).reshape(-1), dtype=torch.float32)
        logit = np.log(color / (1 - color))
        field.features.data[grid.rows] = torch.tensor(logit.reshape(-1, 3), dtype=torch.float32)
    field.touched.fill_(1)
    return field
