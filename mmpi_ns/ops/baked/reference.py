"""Rays through baked multi-plane images in plain torch: every crossing is looked up, then all are put in order."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import linear, relu

from mmpi_ns.ops.gather.reference import COLORS, activate
from mmpi_ns.scene.baked import CELLS, BakedMpis, Shader, brick_numbers, columns_of
from mmpi_ns.scene.geometry import PlaneHits, inverse_distance, plane_hits, sample_disparity

OPAQUE = 1e-2
"""A ray that lets less light through is over."""


class Gathered(NamedTuple):
    """What rays gathered, and what passes them."""

    sums: Float[Tensor, "R C"]
    """Sum of weight times colour and features, of samples that weigh more than the threshold."""
    mass: Float[Tensor, "R 1"]
    """Sum of the weights of those samples."""
    passing: Float[Tensor, "R 1"]
    """Light behind the last sample; 0 once it is less than ``OPAQUE``."""
    inverse_t: Float[Tensor, "R 1"]
    """Inverse distance at which half of the mass is gathered; 0 for infinity, and where there is none."""
    winner: Int[Tensor, "R 1"]
    """The head that gave most weight."""


def march_baked(
    scene: BakedMpis,
    origins: Tensor,
    directions: Tensor,
    nears: Tensor,
    fars: Tensor,
    threshold: float,
    peaks: Any = None,
) -> Gathered:
    """See ``ops.baked``."""
    hits = plane_hits(origins, directions, nears, fars, scene.frames)
    parts = [_head(scene, k, hits) for k in range(len(scene.mpis))]
    tau, inverse_t, texels, bricks = (torch.cat(x, 1) for x in zip(*parts, strict=True))
    heads = torch.cat([torch.full_like(p[3], k) for k, p in enumerate(parts)], 1)
    order = torch.sort(inverse_t, stable=True, dim=-1, descending=True).indices
    tau, inverse_t, bricks, heads = (x.gather(1, order) for x in (tau, inverse_t, bricks, heads))
    texels = texels.gather(1, order[..., None].expand(*order.shape, texels.shape[-1]))
    after = torch.exp(-tau.cumsum(-1))
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
    weights = torch.where(before > OPAQUE, before * -torch.expm1(-tau), 0.0)
    if peaks is not None:
        stored = bricks >= 0
        peaks.scatter_reduce_(0, bricks[stored], weights[stored], "amax")
    weights = torch.where(weights > threshold, weights, 0.0)
    mass = weights.sum(-1, keepdim=True)
    gathered = weights.cumsum(-1)
    half = ((gathered >= 0.5 * mass) & (weights > 0)).to(torch.int8).argmax(-1, keepdim=True)
    passing = after[:, -1:]
    votes = weights.new_zeros(len(weights), len(scene.mpis)).scatter_add(1, heads, weights)
    low, step = (texels.new_tensor([getattr(c, name) for c in scene.channel_codes]) for name in ("low", "step"))
    colors = activate((low + step * texels).flatten(0, 1)).view(texels.shape)
    return Gathered(
        (weights[..., None] * colors).sum(1),
        mass,
        torch.where(passing > OPAQUE, passing, 0.0),
        torch.where(mass > 0, inverse_t.gather(1, half), 0.0),
        votes.argmax(-1, keepdim=True),
    )


def shade_baked(shader: Shader, sums: Tensor, mass: Tensor, directions: Tensor) -> Tensor:
    """See ``ops.baked``."""
    mean = sums / mass.clamp(min=1e-6)
    octaves = math.pi * 2.0 ** torch.arange(shader.direction_octaves, dtype=sums.dtype)
    angles = (directions[:, None] * octaves[:, None]).flatten(1)
    x = torch.cat([mean, directions, angles.sin(), angles.cos()], -1)
    for i, (weights, biases) in enumerate(shader.layers):
        x = linear(relu(x) if i else x, weights.to(x), biases.to(x))
    color = mean[:, :COLORS]
    return color / (color + (1 - color) * torch.exp(-shader.bound * torch.tanh(x / shader.bound)))


def _head(scene: BakedMpis, k: int, hits: PlaneHits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Optical depth, inverse distance, codes and brick on every plane of one MPI [R, P, ...]; 0 and -1 where none."""
    mpi, frames = scene.mpis[k], scene.frames
    first = scene.first_column(k)
    numbers = brick_numbers(scene.columns[first : first + columns_of(mpi)], mpi)
    plane = torch.arange(mpi.planes)
    m = mpi.planes - 1 - plane
    live = (m <= hits.m_first[:, k, None]) & (m > (hits.m_first - hits.count)[:, k, None])
    w = sample_disparity(m, frames.disparity_steps[k], frames.last_disparities[k])
    u0, u1, v0, v1 = mpi.extent
    x = (hits.u[:, k, :1] + w * hits.u[:, k, 1:] - u0) * ((mpi.width - 1) / (u1 - u0))
    y = (hits.v[:, k, :1] + w * hits.v[:, k, 1:] - v0) * ((mpi.height - 1) / (v1 - v0))
    tile_x, fx = _split(x, mpi.width)
    tile_y, fy = _split(y, mpi.height)
    brick = torch.where(live, numbers[plane, tile_y[0], tile_x[0]], -1)
    live = brick >= 0
    index = torch.where(live, brick, scene.num_bricks)
    density, texels_of = (
        torch.cat([table, table.new_zeros(1, *table.shape[1:])]) for table in (scene.density, scene.texels)
    )
    codes, texels = 0.0, 0.0
    for dy, wy in ((0, 1 - fy), (1, fy)):
        for dx, wx in ((0, 1 - fx), (1, fx)):
            at = index, tile_y[1] + dy, tile_x[1] + dx
            codes = codes + density[at].float() * (wx * wy)
            texels = texels + texels_of[at].float() * (wx * wy)[..., None]
    local = hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:]
    tau = torch.where(live, scene.optical_depth(k, codes), 0.0)
    return tau, torch.where(live, inverse_distance(w, *local), 0.0), texels, brick


def _split(position: Float[Tensor, "R P"], size: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Tile and lower texel within its brick, and fraction, of positions in texels."""
    position = position.clamp(0, size - 1)
    tile = (position / CELLS).to(torch.int64).clamp(max=-(-(size - 1) // CELLS) - 1)
    lower = (position - tile * CELLS).to(torch.int64).clamp(0, CELLS - 1)
    return (tile, lower), position - tile * CELLS - lower
