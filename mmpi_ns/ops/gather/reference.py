"""What rays gather of the texels along them, in plain torch.

A texel's first three channels are logits of a colour, the others arguments of features. Both are interpolated raw; a
sample has the sigmoids of the first and the hyperbolic tangents of the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops.layout import SceneLayout

COLORS = 3
"""Channels of a texel that are colours."""


@dataclass(frozen=True)
class KnownTaps:
    """Texels that samples read: 4 each of planes, or 8 each of the cube."""

    positions: Int[Tensor, "N B"]
    """Among the values that are read."""
    shares: Float[Tensor, "N B"]


@dataclass(frozen=True)
class RaySums:
    """Sums over the samples of each ray. ``mass``, ``first`` and ``second`` hold the weights fixed."""

    gathered: Float[Tensor, "R C"]
    """Of weight times colour and features."""
    mass: Float[Tensor, "R 1"]
    """Of weight."""
    first: Float[Tensor, "R 3"]
    """Of weight times colour."""
    second: Float[Tensor, "R 3"]
    """Of weight times squared colour."""


def activate(raw: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
    """Colours and features of samples."""
    return torch.cat([raw[:, :COLORS].sigmoid(), raw[:, COLORS:].tanh()], -1)


def gather_taps(
    values: Float[Tensor, "U C"],
    groups: list[KnownTaps],
    slots: Int[Tensor, "N"],
    weights: Float[Tensor, "R S"],
    wanted: Bool[Tensor, "R"],
) -> RaySums:
    """Sums over samples whose taps are known, with gradients to ``values`` and ``weights``.

    Args:
        values: texels that the batch reads.
        groups: taps of the samples, those of planes first.
        slots: flat slot of each sample in ``weights``.
        weights: rendering weights.
        wanted: the rays to sum for; the others get 0.
    """
    if not groups:
        return _sums(values.new_zeros(0, values.shape[1]), slots, weights)
    raw = torch.cat([(values[g.positions] * g.shares[..., None]).sum(1) for g in groups])
    own = wanted[slots // weights.shape[1]].nonzero()[:, 0]
    return _sums(raw[own], slots[own], weights)


def gather_places(
    layout: SceneLayout,
    table: Float[Tensor, "T C"],
    heads: Int[Tensor, "R S"],
    planes: Int[Tensor, "R S"],
    ndc: Float[Tensor, "R S 3"],
    valid: Bool[Tensor, "R S"],
    weights: Float[Tensor, "R S"],
) -> RaySums:
    """Sums over samples at places in the heads, without gradients.

    Args:
        layout: of the scene.
        table: the pooled texels.
        heads: head of each sample.
        planes: its plane; of no meaning in the cube.
        ndc: its position in the head.
        valid: which slots hold a sample.
        weights: rendering weights.
    """
    slots, raw = zip(*interpolated(layout, table, heads, planes, ndc, valid), strict=True)
    return _sums(torch.cat(raw), torch.cat(slots), weights)


def interpolated(
    layout: SceneLayout, table: Tensor, heads: Tensor, planes: Tensor, ndc: Tensor, valid: Tensor
) -> Iterator[tuple[Int[Tensor, "N"], Float[Tensor, "N C"]]]:
    """Of each head the flat slots of its samples, and what the table holds at their places; see ``gather_places``."""
    for k, grid in enumerate(layout.grids):
        own = (valid & (heads == k)).reshape(-1).nonzero()[:, 0]
        place = ndc.reshape(-1, 3)[own]
        rows, shares = grid.bilinear(planes.reshape(-1)[own], place) if k < len(layout.mpis) else grid.trilinear(place)
        yield own, (table[rows] * shares[..., None]).sum(1)


def _sums(raw: Tensor, slots: Tensor, weights: Tensor) -> RaySums:
    rays, num_rays = slots // weights.shape[1], weights.shape[0]
    value, weight = activate(raw), weights.reshape(-1)[slots][:, None]
    gathered = value.new_zeros(num_rays, raw.shape[1]).index_add(0, rays, weight * value)
    weight, colors = weight.detach(), value[:, :COLORS]
    sums = value.new_zeros(num_rays, 7).index_add(0, rays, torch.cat([weight, weight * colors, weight * colors**2], -1))
    return RaySums(gathered, sums[:, :1].detach(), sums[:, 1:4], sums[:, 4:])
