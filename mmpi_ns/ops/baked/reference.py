"""Rays through baked multi-plane images in plain torch: every crossing is looked up, then all are put in order."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import linear, relu

from mmpi_ns.ops.gather.reference import COLORS, activate
from mmpi_ns.scene.baked import CELLS, SIDE, BakedMpis, Shader, brick_numbers, columns_of
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


class _Samples(NamedTuple):
    """All crossings of rays with bricks, nearest first; weight 0 where a ray is over or nothing is stored."""

    weights: Float[Tensor, "R S"]
    inverse_t: Float[Tensor, "R S"]
    colors: Float[Tensor, "R S C"]
    heads: Int[Tensor, "R S"]
    taps: Int[Tensor, "R S 4"]
    """Texels that a sample reads, counted through all bricks."""
    shares: Float[Tensor, "R S 4"]
    passing: Float[Tensor, "R 1"]


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
    samples = _samples(scene, origins, directions, nears, fars)
    weights = samples.weights
    if peaks is not None:
        each = weights[..., None].expand(samples.taps.shape)
        peaks.view(-1).scatter_reduce_(0, samples.taps.flatten(), each.flatten().to(peaks), "amax")
    weights = torch.where(weights > threshold, weights, 0.0)
    mass = weights.sum(-1, keepdim=True)
    half = ((weights.cumsum(-1) >= 0.5 * mass) & (weights > 0)).to(torch.int8).argmax(-1, keepdim=True)
    votes = weights.new_zeros(len(weights), len(scene.mpis)).scatter_add(1, samples.heads, weights)
    return Gathered(
        (weights[..., None] * samples.colors).sum(1),
        mass,
        torch.where(samples.passing > OPAQUE, samples.passing, 0.0),
        torch.where(mass > 0, samples.inverse_t.gather(1, half), 0.0),
        votes.argmax(-1, keepdim=True),
    )


def _samples(scene: BakedMpis, origins: Tensor, directions: Tensor, nears: Tensor, fars: Tensor) -> _Samples:
    if scene.num_bricks == 0:
        none = origins.new_zeros(len(origins), 1)
        taps = torch.zeros(len(origins), 1, 4, dtype=torch.int64)
        colors = none[..., None].expand(-1, 1, scene.texels.shape[-1])
        return _Samples(none, none, colors, none.to(torch.int64), taps, taps.to(none), torch.ones_like(none))
    hits = plane_hits(origins, directions, nears, fars, scene.frames)
    parts = [_head(scene, k, hits) for k in range(len(scene.mpis))]
    tau, inverse_t, taps, shares = (torch.cat(x, 1) for x in zip(*parts, strict=True))
    heads = torch.cat([torch.full(p[0].shape, k) for k, p in enumerate(parts)], 1)
    order = torch.sort(inverse_t, stable=True, dim=-1, descending=True).indices
    tau, inverse_t, heads = (x.gather(1, order) for x in (tau, inverse_t, heads))
    taps, shares = (x.gather(1, order[..., None].expand(x.shape)) for x in (taps, shares))
    after = torch.exp(-tau.cumsum(-1))
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
    weights = torch.where(before > OPAQUE, before * -torch.expm1(-tau), 0.0)
    low, step = (shares.new_tensor([getattr(c, name) for c in scene.channel_codes]) for name in ("low", "step"))
    codes = (scene.texels.view(-1, len(low))[taps] * shares[..., None]).sum(-2)
    colors = activate((low + step * codes).flatten(0, 1)).view(codes.shape)
    return _Samples(weights, inverse_t, colors, heads, taps, shares, after[:, -1:])


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
    """Optical depth and inverse distance [R, P], texels and their shares [R, P, 4] on every plane of one MPI; zeros
    where nothing is stored."""
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
    corner = (brick.clamp(min=0) * SIDE + tile_y[1]) * SIDE + tile_x[1]
    taps = corner[..., None] + torch.tensor([0, 1, SIDE, SIDE + 1])
    shares = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
    codes = (scene.density.view(-1)[taps] * shares).sum(-1)
    local = hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:]
    tau = torch.where(live, scene.optical_depth(k, codes), 0.0)
    return tau, torch.where(live, inverse_distance(w, *local), 0.0), taps, shares


def _split(position: Float[Tensor, "R P"], size: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Tile and lower texel within its brick, and fraction, of positions in texels."""
    position = position.clamp(0, size - 1)
    tile = (position / CELLS).to(torch.int64).clamp(max=-(-(size - 1) // CELLS) - 1)
    lower = (position - tile * CELLS).to(torch.int64).clamp(0, CELLS - 1)
    return (tile, lower), position - tile * CELLS - lower
