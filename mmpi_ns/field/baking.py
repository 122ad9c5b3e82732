"""Shares of blending at texels: what reliability leaves of each texel's optical depth, for baked scenes.

Blending looks up, for every sample, the reliability of each head that covers its position (paper sec. III-C). The
resulting share depends on the position alone, so a baked texel stores the optical depth that is left.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.blending import log_shares
from mmpi_ns.scene import geometry
from mmpi_ns.scene.texels import BRICK

AT_ONCE = 1 << 18
"""Texels whose shares are computed together."""


@torch.no_grad()
def bake_shares(field: MMPIField) -> Float[Tensor, "N 1"]:
    """Shares P of all rows of a field's tables, among the heads that cover the position of the texel; 1 elsewhere."""
    shares = torch.ones_like(field.density)
    rows = torch.arange(BRICK, len(shares), device=shares.device)
    for k, grid in enumerate(field.grids):
        stored = rows[grid.holds(rows)]
        z, y, x = grid.texel(stored)
        exists = (y < grid.height) & (x < grid.width)  # tiles extend beyond the borders of a plane
        sizes = torch.tensor([grid.width, grid.height, grid.depth], device=stored.device)
        ndc = (2 * torch.stack([x, y, z], -1)[exists] / (sizes - 1) - 1).to(shares.dtype)
        for part, places in zip(stored[exists].split(AT_ONCE), ndc.split(AT_ONCE), strict=True):
            origins, directions, inverse_t = rays_to(field, k, places)
            local = geometry.LocalRays.of(origins, directions, field.layout.frames)
            numbers = torch.arange(len(part), device=part.device)
            samples = (numbers, local, inverse_t, torch.full_like(numbers, k))
            log_share, _ = log_shares(field.layout, field.reliability, field.touched, *samples)
            shares[part, 0] = log_share.exp()
    return shares


def rays_to(
    field: MMPIField, k: int, ndc: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """Rays from a head's own origin to positions in it, to keep precision far from the world origin.

    Args:
        field: of the head.
        k: its number.
        ndc: positions in it.

    Returns:
        Origins, directions (not of unit length), and inverse distances in units of those.
    """
    cube = field.layout.cube
    if k == len(field.plan.mpis):
        assert cube is not None
        return cube.lower.expand_as(ndc), (ndc + 1) / 2 * (cube.upper - cube.lower), torch.ones_like(ndc[:, 0])
    mpi, frames = field.plan.mpis[k], field.layout.frames
    u0, u1, v0, v1 = mpi.extent
    u, v = u0 + (ndc[:, 0] + 1) / 2 * (u1 - u0), v0 + (ndc[:, 1] + 1) / 2 * (v1 - v0)
    disparity = (1 - ndc[:, 2]) / 2 / mpi.near * mpi.depth_share + mpi.last_disparity
    directions = geometry.rotate(frames.axes[k].T, torch.stack([u, v, torch.ones_like(u)], -1))
    return frames.origins[k].expand_as(ndc), directions, disparity
