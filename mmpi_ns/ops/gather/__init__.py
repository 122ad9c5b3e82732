"""Sums along rays of rendering weight times colour and features.

The first three channels of a texel are logits of a colour, the others arguments of features. Both are interpolated raw;
a sample has the sigmoids of the former and the hyperbolic tangents of the latter.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Int32
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import call_in_parts, owned_bounds, structs
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.interpolate import interpolate_densely
from mmpi_ns.ops.layout import Places, SceneLayout

COLORS = 3
"""Channels of a texel that are colours."""


@dataclass(frozen=True)
class Taps:
    """Texels that samples read: 4 per sample on planes, or 8 per sample of the cube."""

    positions: Int[Tensor, "N B"]
    """Of the texels in the list of values."""
    weights: Float[Tensor, "N B"]
    """Of the interpolation."""


@dataclass(frozen=True)
class RaySums:
    """Sums over the samples of each ray, of which ``mass``, ``first`` and ``second`` hold the weights fixed."""

    gathered: Float[Tensor, "R C"]
    """Sum of weight times colour and features."""
    mass: Float[Tensor, "R 1"]
    """Sum of weight."""
    first: Float[Tensor, "R 3"]
    """Sum of weight times colour."""
    second: Float[Tensor, "R 3"]
    """Sum of weight times squared colour."""


def activate(raw: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
    """Colours and features of samples."""
    return torch.cat([raw[:, :COLORS].sigmoid(), raw[:, COLORS:].tanh()], -1)


@operation("gpu")
def gather_taps(
    values: Float[Tensor, "U C"],
    taps: list[Taps],
    slots: Int[Tensor, "N"],
    weights: Float[Tensor, "R S"],
    chosen: Bool[Tensor, "R"],
) -> RaySums:
    """Sums over the samples of rays, with gradients to ``values``, ``weights`` and the taps' weights.

    Args:
        values: texels that the batch reads.
        taps: of the samples, those on planes first.
        slots: flat slot of each sample in ``weights``.
        weights: rendering weights.
        chosen: rays to sum for; the others get 0.
    """
    if not taps:
        return _sums(values.new_zeros(0, values.shape[1]), slots, weights)
    raw = torch.cat([interpolate_densely(values, t.positions, t.weights) for t in taps])
    samples = chosen[slots // weights.shape[1]].nonzero()[:, 0]
    return _sums(raw[samples], slots[samples], weights)


def gather_places(
    layout: SceneLayout, table: Float[Tensor, "T C"], places: Places, weights: Float[Tensor, "R S"]
) -> RaySums:
    """Sums over samples at places in the heads, without gradients; ``table`` holds all texels. In plain torch only:
    ``ops.march`` renders images."""
    slots, raw = [], []
    for k, grid in enumerate(layout.grids):
        slots.append((places.valid & (places.heads == k)).reshape(-1).nonzero()[:, 0])
        ndc, planes = places.ndc.reshape(-1, 3)[slots[k]], places.planes.reshape(-1)[slots[k]]
        rows, shares = grid.bilinear(planes, ndc) if k < len(layout.mpis) else grid.trilinear(ndc)
        raw.append(interpolate_densely(table, rows, shares))
    return _sums(torch.cat(raw), torch.cat(slots), weights)


def _sums(raw: Tensor, slots: Tensor, weights: Tensor) -> RaySums:
    rays, num_rays = slots // weights.shape[1], weights.shape[0]
    value, weight = activate(raw), weights.reshape(-1)[slots][:, None]
    gathered = value.new_zeros(num_rays, raw.shape[1]).index_add(0, rays, weight * value)
    weight, colors = weight.detach(), value[:, :COLORS]
    sums = value.new_zeros(num_rays, 7).index_add(0, rays, torch.cat([weight, weight * colors, weight * colors**2], -1))
    return RaySums(gathered, sums[:, :1].detach(), sums[:, 1:4], sums[:, 4:])


def number_samples(
    slots: Int[Tensor, "N"], chosen: Bool[Tensor, "R"], weights: Float[Tensor, "R S"]
) -> Int32[Tensor, "R S"]:
    """Number of the sample in each slot of the chosen rays; -1 where there is none."""
    numbers = torch.full(weights.shape, -1, dtype=torch.int32, device=weights.device)
    numbers.view(-1)[slots] = torch.arange(len(slots), dtype=torch.int32, device=weights.device)
    return numbers.masked_fill_(~chosen[:, None], -1)


LANES = 16
"""Gradients of sums are padded to multiples of this many channels."""
AT_LEAST = 1 << 14
"""Texels read that justify another thread."""


def _groups(taps: list[Tensor], to_weights: Sequence[Tensor | None] = (None, None)) -> ctypes.Array:
    """The taps of planes, then those of the cube, with the gradients of their weights: ``Taps`` of ``gather.cpp``."""
    groups: list[tuple] = [(None, None, 0, None)] * 2
    for positions, weights, to in zip(taps[::2], taps[1::2], to_weights, strict=False):
        groups[positions.shape[1] // 8] = (positions, weights, len(positions), to)
    return structs(*groups)


class _GatherTaps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, weights: Tensor, slots: Tensor, chosen: Tensor, *taps: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        (num_rays, width), channels = weights.shape, values.shape[1]
        saved = [x.contiguous() for x in (values, weights, slots, chosen, *taps)]
        values, weights, slots, chosen = saved[:4]
        numbers = number_samples(slots, chosen, weights)
        sums = torch.empty(num_rays, channels + 1 + COLORS)
        samples = (_groups(saved[4:]), numbers, weights, width)
        call_in_parts("mmpi_gather_taps", num_rays, values, *values.shape, *samples, sums)
        ctx.save_for_backward(*saved)
        gathered, mass, second = sums.split([channels, 1, COLORS], -1)
        ctx.mark_non_differentiable(mass)
        return gathered, mass, gathered[:, :COLORS].clone(), second

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        values, weights, slots, chosen, *taps = ctx.saved_tensors
        to_sums, _, to_first, to_second = grad_outputs
        to_values = torch.empty_like(values) if ctx.needs_input_grad[0] else None
        to_weights = torch.zeros_like(weights)
        moved = zip(taps[1::2], ctx.needs_input_grad[5::2], strict=True)
        to_taps = [torch.zeros_like(x) if is_needed else None for x, is_needed in moved]
        batch = (values, *values.shape, _groups(taps, to_taps), slots, chosen, weights)
        grads = [pad(g, (0, -g.shape[1] % LANES)).contiguous() for g in (to_sums, to_first, 2 * to_second)]
        bounds = owned_bounds(taps[::2], len(values), AT_LEAST)
        call_in_parts("mmpi_gather_back", bounds, *batch, *grads, weights.shape[1], to_values, to_weights)
        return to_values, to_weights, None, None, *(x for to in to_taps for x in (None, to))


@gather_taps.on_cpu
def gather_taps_on_cpu(values: Tensor, taps: list[Taps], slots: Tensor, weights: Tensor, chosen: Tensor) -> RaySums:
    """``gather_taps`` in C++, whose gradients do not depend on the number of threads."""
    tensors = [x for t in taps for x in (t.positions.to(torch.int32), t.weights)]
    return RaySums(*_GatherTaps.apply(values, weights, slots, chosen, *tensors))  # type: ignore[misc]
