"""Tables before the first step: surfaces at the depth priors (docs/how_it_works.md, "Initial surfaces").

Otherwise every plane starts with the same weight, and a ray has hundreds of samples that all learn until surfaces form.
A ray with a depth prior votes for a surface there, and for empty space on the planes before it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.data.ray_sources import RaySources
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.geometry import inverse_distance, plane_hits, sample_disparity
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.utils.random_draws import generator

BATCHES, BATCH = 20, 4096
"""Batches of rays that vote, and pixel rays of a batch; rays of new views come on top."""
PRIOR = 16.0
"""Number of votes of the prior, equal weights of all planes."""
PLANE_ERROR = 0.6
"""Minimum error of a depth, in plane spacings: a surface between two planes is on both."""
EMPTY_FROM = 2.0
"""Distance before a surface, in errors, beyond which a ray's planes get votes for empty space."""
DARKEST = 0.02
"""Minimum initial colour, and its complement the maximum, so that gradients of the logits do not vanish."""


class Votes(NamedTuple):
    """Votes of rays with a depth prior for each of the T rows of the tables."""

    surface: Float[Tensor, "T"]
    """Votes for a surface; those of one ray, on all planes within the error of its depth, sum to one or two."""
    empty: Float[Tensor, "T"]
    """Votes for empty space: rays whose surface lies behind."""
    colors: Float[Tensor, "T 3"]
    """Sum of the colours of the votes for a surface."""

    def add(
        self,
        layout: SceneLayout,
        origins: Float[Tensor, "R 3"],
        directions: Float[Tensor, "R 3"],
        depths: Float[Tensor, "R 2"],
        colors: Float[Tensor, "R 3"],
        ray_near: float,
    ) -> None:
        """Adds the votes of rays in world axes, each for the nearest texel on every plane that it intersects.
        ``depths`` are inverse distances of the surfaces and their expected errors; rays start at ``ray_near``."""
        ends = torch.full_like(origins[:, :1], ray_near), torch.full_like(origins[:, :1], torch.inf)
        hits = plane_hits(origins, directions, *ends, layout.frames)
        for k, (mpi, grid) in enumerate(zip(layout.mpis, layout.grids, strict=False)):
            m = torch.arange(mpi.planes, device=origins.device)
            last = hits.m_first[:, k, None] - hits.count[:, k, None]
            w = sample_disparity(m, layout.frames.disparity_steps[k], layout.frames.last_disparities[k])
            oz, dz = hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:]
            # Spacing of the planes along the ray, in inverse distance; planes at the camera are excluded.
            spacing = mpi.disparity_step * dz.abs() / (1 - w * oz).clamp(min=1e-3) ** 2
            error = torch.maximum(depths[:, 1:], PLANE_ERROR * spacing)
            before = (inverse_distance(w, oz, dz) - depths[:, :1]) / error
            votes = (m > last) & (m <= hits.m_first[:, k, None]) & ((before.abs() <= 1) | (before > EMPTY_FROM))
            rays, behind = votes.nonzero(as_tuple=True)
            u0, u1, v0, v1 = mpi.extent
            x, y = (
                ((slopes[rays, k, 0] + w[behind] * slopes[rays, k, 1] - low) / (high - low) * (n - 1)).round().long()
                for slopes, low, high, n in ((hits.u, u0, u1, grid.width), (hits.v, v0, v1, grid.height))
            )
            rows = grid.row(mpi.planes - 1 - behind, y.clamp(0, grid.height - 1), x.clamp(0, grid.width - 1))
            surface = before[rays, behind] <= 1
            self.empty.index_add_(0, rows, (~surface).float())
            share = (spacing / error).clamp(max=1)[rays, behind] * surface
            self.surface.index_add_(0, rows, share)
            self.colors.index_add_(0, rows, share[:, None] * colors[rays])


@torch.no_grad()
def start_from_votes(field: MMPIField, votes: Votes) -> None:
    """Sets densities and diffuse colours of the texels that have votes.

    The alpha of a texel is the share of its votes for a surface, with PRIOR further votes at the alpha of equal
    weights. Texels without votes, and the empty brick, do not change.
    """
    layout = field.layout
    for k, (mpi, grid) in enumerate(zip(layout.mpis, layout.grids, strict=False)):
        for plane in range(mpi.planes):
            bricks = grid.own_tiles[plane][grid.own_tiles[plane] > 0].long()
            rows = (bricks[:, None] * BRICK + torch.arange(BRICK, device=bricks.device)).reshape(-1)
            rows = rows[votes.surface[rows] + votes.empty[rows] > 0]
            surface, empty = votes.surface[rows], votes.empty[rows]
            start = -torch.expm1(-layout.optical_depth(k, surface.new_zeros(1), rows.new_full((1,), plane)))
            alpha = (surface + PRIOR * start) / (surface + empty + PRIOR)
            softplus = -torch.log1p(-alpha) / layout.interval(k)
            raw = softplus + torch.log(-torch.expm1(-softplus))  # the inverse of softplus, without overflow
            field.density.data[rows, 0] = raw - layout.biases[k][plane]
            has_color = surface > 0
            colors = votes.colors[rows[has_color]] / surface[has_color, None]
            field.features.data[rows[has_color], :3] = colors.clamp(DARKEST, 1 - DARKEST).logit()


def start_from_depths(field: MMPIField, sources: RaySources, seed: int) -> None:
    """Initialises a new field from the depth priors of a window's training pixels and new views."""
    sizes = len(field.density), len(field.density), (len(field.density), 3)
    votes = Votes(*(torch.zeros(size, device=field.density.device) for size in sizes))
    for i in range(BATCHES):
        rays, batch = sources.draw(BATCH, generator(seed, i, "initial", field.density.device))
        rays, images = rays[0], batch["image"][0]
        assert rays.disparities is not None
        depths = rays.disparities[: len(images)]
        measured = (depths[:, 0] > 0).nonzero()[:, 0]
        parts = rays.origins[measured], rays.directions[measured], depths[measured], images[measured, :3]
        votes.add(field.layout, *parts, field.plan.ray_near)
    start_from_votes(field, votes)
