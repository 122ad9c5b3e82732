"""Blending by reliability: the share of a sample among the heads that cover its position (paper sec. III-C).

Plain torch, with gradients. The compiled marches contain their own form without gradients.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.interpolate import interpolate
from mmpi_ns.ops.layout import SceneLayout
from mmpi_ns.scene.geometry import Frames, LocalRays, local_to_ndc


def blend_shares(
    reliability: Float[Tensor, "N H"], cover: Bool[Tensor, "N H"], heads: Int[Tensor, "N"]
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """log P and log(1 - P) of each sample's own head among the heads that cover it.

    Args:
        reliability: R of every head at the sample's position; values of heads that do not cover it are ignored.
        cover: which heads cover the position; a sample's own head must be among them.
        heads: the head that each sample was taken from.

    Returns:
        log softmax over the covering heads at ``heads``, and the log of its complement (-inf for a sole cover).

    Source: paper sec. III-C, P_i = exp(R_i) / sum_j exp(R_j). log(1 - P) comes from the other heads directly:
    from P itself it is wrong beyond R = 17 and has a NaN gradient at P = 1.
    """
    reliability = reliability.float() if reliability.dtype in (torch.float16, torch.bfloat16) else reliability
    lowest = torch.finfo(reliability.dtype).min
    # Only differences matter, and they are exact only for small numbers: the highest becomes 0.
    highest = torch.where(cover, reliability, torch.full_like(reliability, lowest)).amax(-1, keepdim=True).detach()
    reliability = reliability - highest
    is_own = torch.arange(cover.shape[-1], device=cover.device) == heads[:, None]
    own_value = torch.where(is_own, reliability, torch.zeros_like(reliability)).sum(-1)
    others = cover & ~is_own
    has_others = others.any(-1)
    # A row without others would be a logsumexp over nothing: give it a harmless row and mask the result.
    other_values = torch.where(others, reliability, torch.full_like(reliability, lowest))
    other_values = torch.where(has_others[:, None], other_values, torch.zeros_like(other_values))
    odds = torch.logsumexp(other_values, -1) - own_value
    # With softplus, both logs and both slopes are exact at P near 0 and 1; differences from the sum would cancel there.
    # From the threshold on torch returns its argument: at the default of 20, float64 could tell them apart.
    over, under = (torch.nn.functional.softplus(x, threshold=50) for x in (odds, -odds))
    log_share = torch.where(has_others, -over, torch.zeros_like(odds))
    log_rest = torch.where(has_others, -under, torch.full_like(odds, -torch.inf))
    return log_share, log_rest


def blended_optical_depth(
    tau: Float[Tensor, "N"], log_share: Float[Tensor, "N"], log_rest: Float[Tensor, "N"]
) -> Float[Tensor, "N"]:
    """-log(1 - alpha') of a sample after blending; exactly tau if no other head covers it.

    Source: paper sec. III-C, alpha' = P alpha, so 1 - alpha' = (1 - P) + P (1 - alpha).
    """
    sole = torch.isneginf(log_rest)
    # Two forms of one number: the first is exact for thin samples (and 0 for empty ones), the second for opaque ones.
    alpha = -torch.expm1(-tau) * log_share.exp()
    thin = alpha < 0.5
    log1p = torch.log1p(-torch.where(thin, alpha, torch.zeros_like(alpha)))
    safe_rest = torch.where(sole, torch.zeros_like(log_rest), log_rest)
    blended = -torch.where(thin, log1p, torch.logaddexp(safe_rest, log_share - tau))
    return torch.where(sole, tau, blended.clamp(min=0))


def log_shares(
    layout: SceneLayout,
    reliability: Float[Tensor, "T 1"],
    touched: Tensor,
    rays: Int[Tensor, "N"],
    local: LocalRays,
    inverse_t: Float[Tensor, "N"],
    heads: Int[Tensor, "N"],
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """log P and log(1 - P) of samples among the heads that cover them, with gradients to the reliability.

    A head covers a point in its frustum if the nearest texel was trained; a sample's own head always covers it.

    Args:
        layout: of the scene.
        reliability: R of all texels.
        touched: for every row [T]: 1 if a training ray read it.
        rays: ray of each sample.
        local: the rays in every head's axes.
        inverse_t: inverse distance of each sample.
        heads: head that each sample was taken from.
    """
    if dispatch.on_gpu(inverse_t):
        votes = voting_texels(layout, touched, local.origins, local.directions, rays, inverse_t, heads)
        values = interpolate(reliability, votes.rows.flatten(0, 1), votes.weights.flatten(0, 1))
        return blend_shares(values.view(votes.cover.shape), votes.cover, heads)
    chosen, texels, cover = [], [], []
    for j, grid in enumerate(layout.grids):
        ndc, inside = _position(layout, j, local, rays, inverse_t)
        is_own = heads == j
        votes = inside | is_own
        index = votes.nonzero()[:, 0]
        position = ndc[index]
        chosen.append(index)
        texels.append(grid.trilinear(position))
        trained = touched[grid.nearest(position)] > 0
        cover.append(torch.zeros_like(is_own).index_copy(0, index, trained) | is_own)
    # Read at once: gradients of the table are then one list of rows.
    values = interpolate(reliability, *(torch.cat(parts) for parts in zip(*texels, strict=True)))[:, 0]
    each = zip(values.split([len(i) for i in chosen]), chosen, strict=True)
    columns = [value.new_zeros(len(heads)).index_copy(0, index, value) for value, index in each]
    return blend_shares(torch.stack(columns, -1), torch.stack(cover, -1), heads)


class Votes(NamedTuple):
    """What each head says of each sample."""

    rows: Int[Tensor, "N H 8"]
    """Of its texels around the sample; 0 where the head does not cover it."""
    weights: Float[Tensor, "N H 8"]
    cover: Bool[Tensor, "N H"]
    """Whether the head has a vote."""


@dispatch.operation("gpu")
def voting_texels(
    layout: SceneLayout,
    touched: UInt8[Tensor, "T"],
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    rays: Int[Tensor, "N"],
    inverse_t: Float[Tensor, "N"],
    heads: Int[Tensor, "N"],
) -> Votes:
    """Texels of every head around samples: all of ``log_shares`` that needs no gradient.

    Args:
        layout: of the scene.
        touched: 1 if a training ray read the row.
        origins: of the rays, world axes.
        directions: likewise, unit.
        rays: ray of each sample.
        inverse_t: inverse distance of each sample.
        heads: head that each sample was taken from.
    """
    local, texels, cover = LocalRays.of(origins, directions, layout.frames), [], []
    for j, grid in enumerate(layout.grids):
        ndc, inside = _position(layout, j, local, rays, inverse_t)
        is_own = heads == j
        rows, weights = grid.trilinear(ndc)
        texels.append((rows * (inside | is_own)[:, None], weights))
        cover.append(inside & (touched[grid.nearest(ndc)] > 0) | is_own)
    rows, weights = (torch.stack(parts, 1) for parts in zip(*texels, strict=True))
    return Votes(rows, weights, torch.stack(cover, -1))


def _position(
    layout: SceneLayout, head: int, local: LocalRays, rays: Int[Tensor, "N"], inverse_t: Float[Tensor, "N"]
) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]:
    """NDC of samples in a head, and whether they lie in it."""
    if head < len(layout.mpis):
        origins, directions = (x[:, head].index_select(0, rays) for x in (local.local_origins, local.local_directions))
        point = origins * inverse_t[:, None] + directions
        frame = Frames(*(x[head : head + 1] for x in vars(layout.frames).values()))
        ndc, inside = (x[:, 0] for x in local_to_ndc(point[:, None], inverse_t[:, None], frame))
        return ndc, inside
    assert layout.cube is not None
    origins, directions = (x.index_select(0, rays) for x in (local.origins, local.directions))
    ndc = layout.cube.normalised(origins + directions / inverse_t.clamp(min=1e-10)[:, None])
    return ndc.clamp(-1, 1), (ndc.abs() <= 1).all(-1) & (inverse_t > 0)
