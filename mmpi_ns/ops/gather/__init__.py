"""Sums along rays of rendering weight times colour and features.

The first three channels of a texel are logits of a colour, the others arguments of features. Both are interpolated raw;
a sample has the sigmoids of the former and the hyperbolic tangents of the latter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mmpi_ns.ops.build import call_in_parts, owned_bounds
from mmpi_ns.ops.composite import ray_numbers, sum_by_ray
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.interpolate import interpolate_densely

COLORS = 3
"""Channels of a texel that are colours."""


@dataclass(frozen=True)
class Taps:
    """Texels that samples read (``texel_rows``)."""

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
    taps: Taps,
    starts: Int[Tensor, "R+1"],
    weights: Float[Tensor, "N"],
    chosen: Bool[Tensor, "R"] | None = None,
) -> RaySums:
    """Sums over the samples of rays, with gradients to ``values``, ``weights`` and the taps' weights.

    Args:
        values: texels that the batch reads.
        taps: of the samples.
        starts: of the rays' samples (``MergedSamples``).
        weights: rendering weights.
        chosen: rays to sum for; the others get 0. None for all.
    """
    numbers = ray_numbers(starts, len(weights))
    if chosen is not None:
        numbers = torch.where(torch.nn.functional.pad(chosen, (0, 1))[numbers], numbers, len(chosen))
    value = activate(interpolate_densely(values, taps.positions, taps.weights))
    gathered = sum_by_ray(weights[:, None] * value, starts, numbers)
    weight, colors = weights.detach()[:, None], value[:, :COLORS]
    sums = sum_by_ray(torch.cat([weight, weight * colors, weight * colors**2], -1), starts, numbers)
    return RaySums(gathered, sums[:, :1].detach(), sums[:, 1:4], sums[:, 4:])


LANES = 16
"""Gradients of sums are padded to multiples of this many channels."""
AT_LEAST = 1 << 14
"""Texels read that justify another thread."""


class _GatherTaps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, positions: Tensor, shares: Tensor, starts: Tensor, weights: Tensor, chosen: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        num_rays, channels = len(starts) - 1, values.shape[1]
        saved = [x if x is None else x.contiguous() for x in (values, positions, shares, starts, weights, chosen)]
        sums = torch.empty(num_rays, channels + 1 + COLORS)
        call_in_parts("mmpi_gather_taps", num_rays, *values.shape, shares.shape[1], *saved, sums)
        ctx.save_for_backward(*saved)
        gathered, mass, second = sums.split([channels, 1, COLORS], -1)
        ctx.mark_non_differentiable(mass)
        return gathered, mass, gathered[:, :COLORS].clone(), second

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        values, positions, shares, starts, weights, _ = saved = ctx.saved_tensors
        to_sums, _, to_first, to_second = grad_outputs
        to_values = torch.empty_like(values) if ctx.needs_input_grad[0] else None
        to_shares = torch.zeros_like(shares) if ctx.needs_input_grad[2] else None
        to_weights = torch.zeros_like(weights)
        grads = [pad(g, (0, -g.shape[1] % LANES)).contiguous() for g in (to_sums, to_first, 2 * to_second)]
        bounds = owned_bounds([positions], len(values), AT_LEAST)
        sizes = (*values.shape, shares.shape[1], len(starts) - 1)
        call_in_parts("mmpi_gather_back", bounds, *sizes, *saved, *grads, to_values, to_shares, to_weights)
        return to_values, None, to_shares, None, to_weights, None


@gather_taps.on_cpu
def gather_taps_on_cpu(
    values: Tensor, taps: Taps, starts: Tensor, weights: Tensor, chosen: Tensor | None = None
) -> RaySums:
    """``gather_taps`` in C++, whose gradients do not depend on the number of threads."""
    samples = (taps.positions.to(torch.int32), taps.weights, starts, weights, chosen)
    return RaySums(*_GatherTaps.apply(values, *samples))  # type: ignore[misc]
