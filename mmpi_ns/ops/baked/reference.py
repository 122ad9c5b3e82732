"""Rays through baked multi-plane images in plain torch: every crossing is looked up, then all are put in order."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import linear, relu

from mmpi_ns.ops.composite import median_inverse_distance, winning_heads
from mmpi_ns.ops.ends import OPAQUE_BAKED
from mmpi_ns.ops.gather.reference import COLORS, activate
from mmpi_ns.ops.march.rays import Rays, Shown
from mmpi_ns.scene.baked import CELLS, SIDE, BakedMpis, Shader, brick_numbers, columns_of
from mmpi_ns.scene.geometry import PlaneHits, inverse_distance, plane_hits, sample_disparity


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


def show_baked(scene: BakedMpis, rays: Rays, threshold: float, peaks: Tensor | None = None) -> Shown:
    """See ``ops.baked``."""
    samples = _samples(scene, rays)
    if peaks is not None:
        each = samples.weights[..., None].expand(samples.taps.shape)
        peaks.view(-1).scatter_reduce_(0, samples.taps.flatten(), each.flatten().to(peaks), "amax")
    kept = samples.weights > threshold
    weights = torch.where(kept, samples.weights, 0.0)
    mass = weights.sum(-1, keepdim=True)
    transmittance = torch.where(samples.passing > OPAQUE_BAKED, samples.passing, 0.0)
    return Shown(
        gathered=(weights[..., None] * samples.colors).sum(1),
        mass=mass,
        transmittance=transmittance,
        accumulation=1 - transmittance,
        inverse_t=median_inverse_distance(weights, samples.inverse_t, kept),
        winner=winning_heads(weights, samples.heads, len(scene.mpis)),
        dropped_mass=(1 - transmittance - mass).clamp(min=0),
    )


def _samples(scene: BakedMpis, rays: Rays) -> _Samples:
    origins = rays.origins
    if scene.num_bricks == 0:
        none = origins.new_zeros(len(origins), 1)
        taps = torch.zeros(len(origins), 1, 4, dtype=torch.int64)
        colors = none[..., None].expand(-1, 1, scene.texels.shape[-1])
        return _Samples(none, none, colors, none.to(torch.int64), taps, taps.to(none), torch.ones_like(none))
    hits = plane_hits(*rays[:4], scene.frames)
    parts = [_head(scene, k, hits) for k in range(len(scene.mpis))]
    tau, inverse_t, taps, shares = (torch.cat(x, 1) for x in zip(*parts, strict=True))
    heads = torch.cat([torch.full(p[0].shape, k) for k, p in enumerate(parts)], 1)
    order = torch.sort(inverse_t, stable=True, dim=-1, descending=True).indices
    tau, inverse_t, heads = (x.gather(1, order) for x in (tau, inverse_t, heads))
    taps, shares = (x.gather(1, order[..., None].expand(x.shape)) for x in (taps, shares))
    after = torch.exp(-tau.cumsum(-1))
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
    weights = torch.where(before > OPAQUE_BAKED, before * -torch.expm1(-tau), 0.0)
    low, step = (shares.new_tensor([getattr(c, name) for c in scene.channel_codes]) for name in ("low", "step"))
    codes = (scene.texels.view(-1, len(low))[taps] * shares[..., None]).sum(-2)
    colors = activate((low + step * codes).flatten(0, 1)).view(codes.shape)
    return _Samples(weights, inverse_t, colors, heads, taps, shares, after[:, -1:])


def shade_baked(shader: Shader, gathered: Tensor, mass: Tensor, directions: Tensor) -> Tensor:
    """See ``ops.baked``."""
    mean = gathered / mass.clamp(min=1e-6)
    octaves = math.pi * 2.0 ** torch.arange(shader.direction_octaves, dtype=gathered.dtype)
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
