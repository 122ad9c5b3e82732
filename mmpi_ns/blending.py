"""Adaptive blending by reliability: the share of a sample among the heads that cover its position (paper sec. III-C).

Three steps: the heads that cover the sample, and their reliabilities R there (``find_votes``), shares P by a softmax
over them (``blend_shares``), and the sample's optical depth once its alpha is multiplied by its share
(``blended_optical_depth``). With gradients; the compiled marches contain their own form without.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.heads import CubeHead, MPIHead, heads_of
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.interpolate import interpolate
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.votes import Votes, find_votes_on_cpu


@operation("gpu", kernels="mmpi_ns.ops.votes")
def blend_shares(
    reliability: Float[Tensor, "N H"], covers: Bool[Tensor, "N H"], heads: Int[Tensor, "N"]
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """log P and log(1 - P) of each sample's head among the heads that cover it.

    Args:
        reliability: R of every head at the sample's position; values of heads that do not cover it are ignored.
        covers: mask of the heads that cover the position; the sample's head must be among them.
        heads: the head that each sample was taken from.

    Returns:
        log softmax over the covering heads at ``heads``, and the log of its complement (-inf for a sole cover).

    Source: paper sec. III-C, P_i = exp(R_i) / sum_j exp(R_j). log(1 - P) comes from the other heads directly:
    from P itself it is wrong beyond R = 17 and has a NaN gradient at P = 1.
    """
    reliability = reliability.float() if reliability.dtype in (torch.float16, torch.bfloat16) else reliability
    lowest = torch.finfo(reliability.dtype).min
    # Only differences matter, and they are exact only for small numbers: the highest becomes 0.
    highest = torch.where(covers, reliability, torch.full_like(reliability, lowest)).amax(-1, keepdim=True).detach()
    reliability = reliability - highest
    is_own = torch.arange(covers.shape[-1], device=covers.device) == heads[:, None]
    value_of_head = torch.where(is_own, reliability, torch.zeros_like(reliability)).sum(-1)
    others = covers & ~is_own
    has_others = others.any(-1)
    # A row without others would be a logsumexp over nothing: give it a harmless row and mask the result.
    other_values = torch.where(others, reliability, torch.full_like(reliability, lowest))
    other_values = torch.where(has_others[:, None], other_values, torch.zeros_like(other_values))
    odds = torch.logsumexp(other_values, -1) - value_of_head
    # With softplus, both logs and both slopes are exact at P near 0 and 1; differences from the sum would cancel there.
    # Above the threshold torch returns its argument; at the default of 20 this would be wrong in float64.
    over, under = (torch.nn.functional.softplus(x, threshold=50) for x in (odds, -odds))
    log_share = torch.where(has_others, -over, torch.zeros_like(odds))
    log_rest = torch.where(has_others, -under, torch.full_like(odds, -torch.inf))
    return log_share, log_rest


@operation("gpu", kernels="mmpi_ns.ops.votes")
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
    tables: Tables,
    origins: Float[Tensor, "N 3"],
    directions: Float[Tensor, "N 3"],
    inverse_t: Float[Tensor, "N"],
    heads: Int[Tensor, "N"],
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """log P and log(1 - P) of samples among the heads that cover them, with gradients to the reliability. The arguments
    are those of ``find_votes``."""
    votes, shape = find_votes(layout, tables, origins, directions, inverse_t, heads), (len(heads), layout.num_heads)
    values = interpolate(tables.reliability, votes.rows, votes.weights)[:, 0]
    # One more, for what is no vote.
    reliability = values.new_zeros(math.prod(shape) + 1).index_copy(0, votes.places, values)
    covers = torch.zeros_like(reliability, dtype=torch.bool).index_fill(0, votes.places, True)
    return blend_shares(reliability[:-1].view(shape), covers[:-1].view(shape), heads)


@operation("gpu", kernels="mmpi_ns.ops.votes")
def find_votes(
    layout: SceneLayout,
    tables: Tables,
    origins: Float[Tensor, "N 3"],
    directions: Float[Tensor, "N 3"],
    inverse_t: Float[Tensor, "N"],
    heads: Int[Tensor, "N"],
) -> Votes:
    """Texels of the heads that cover samples.

    A head covers a point in its frustum if the nearest texel was trained; a sample's head always covers it.

    Args:
        layout: the scene.
        tables: which texels were trained.
        origins, directions, inverse_t, heads: ray, inverse distance and head of each sample.
    """
    votes, first = [], torch.arange(len(heads), device=heads.device) * layout.num_heads
    for head in heads_of(layout):
        ndc, inside = head.place_on_rays(origins, directions, inverse_t)
        covers = head.covers(tables.touched, ndc, inside) | (heads == head.number)
        places = torch.where(covers, first + head.number, len(heads) * layout.num_heads)
        votes.append((places, *(x * covers[:, None] for x in head.grid.trilinear(ndc))))
    return Votes(*(torch.stack(each, 1).flatten(0, 1) for each in zip(*votes, strict=True)))


def head_shares(
    heads: Sequence[MPIHead | CubeHead],
    places: Sequence[tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]],
    reliability: Float[Tensor, "T 1"],
    touched: Tensor,
) -> Float[Tensor, "N H"]:
    """P of every head at points; 0 where a head does not cover one, and all 0 where none does. ``places`` are from
    ``place_points``, ``touched`` [T] is 1 for rows that a training ray read."""
    covers = torch.stack([head.covers(touched, *place) for head, place in zip(heads, places, strict=True)], -1)
    values = [head.values(reliability, ndc)[:, 0] for head, (ndc, _) in zip(heads, places, strict=True)]
    values = torch.stack(values, -1).masked_fill(~covers, torch.finfo(reliability.dtype).min)
    return torch.where(covers, torch.softmax(values, -1), 0.0)


find_votes.on_cpu(find_votes_on_cpu)
