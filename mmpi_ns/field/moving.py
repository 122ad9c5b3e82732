"""Gradients of sample positions with respect to rays, for pose refinement (docs/how_it_works.md, "Refined poses").

The march has no gradients. A sample stays on its plane, so it moves within that plane when its ray moves:

    u(w) = dx/dz + w (ox - oz dx/dz)

at the plane's disparity w, and likewise v. Depths of planes, which planes a ray meets and which samples are kept are
held fixed; a sample of the cube moves with the point at its distance.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.geometry import FACING_EPS, LocalRays, sample_disparity


def moving(
    layout: SceneLayout,
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    rays: Int[Tensor, "N"],
    heads: Int[Tensor, "N"],
    planes: Int[Tensor, "N"],
    inverse_t: Float[Tensor, "N"],
    ndc: Float[Tensor, "N 3"],
) -> Float[Tensor, "N 3"]:
    """The positions of samples, bit for bit unchanged, with gradients to the rays.

    Args:
        layout: of the scene.
        origins: of the rays, world axes.
        directions: likewise, unit.
        rays: ray of each sample.
        heads: of each sample, rising: those of the cube come last.
        planes: of each sample.
        inverse_t: inverse distances of the samples.
        ndc: their positions.
    """
    count = len(heads) if layout.cube is None else int(torch.searchsorted(heads, len(layout.mpis)))
    frames, mpis = layout.frames, heads[:count]
    local = LocalRays.of(origins, directions, frames)
    o, d = local.local_origins, local.local_directions
    facing = d[..., 2:] > FACING_EPS  # where it is not there are no samples
    slope = d[..., :2] / torch.where(facing, d[..., 2:], 1)
    bend = o[..., :2] - o[..., 2:] * slope
    line = torch.cat([slope, bend], -1).flatten(0, 1).index_select(0, rays[:count] * len(layout.mpis) + mpis)
    m = frames.num_planes[mpis] - 1 - planes[:count]
    w = sample_disparity(m, frames.disparity_steps[mpis], frames.last_disparities[mpis])[:, None]
    size = (frames.extents[:, 1::2] - frames.extents[:, ::2])[mpis]
    # NDC (u, v, .) up to a constant.
    parts = [torch.nn.functional.pad((line[:, :2] + w * line[:, 2:]) * (2 / size), (0, 1))]
    if layout.cube is not None:
        in_cube = rays[count:]
        parts.append(layout.cube.normalised(origins[in_cube] + directions[in_cube] / inverse_t[count:, None]))
    moved = torch.cat(parts)
    return ndc + (moved - moved.detach())
