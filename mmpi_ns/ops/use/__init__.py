"""What a brick is used for: the weights of the samples that read it, and the errors of their rays."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts, owned_bounds
from mmpi_ns.ops.dispatch import operation
from mmpi_ns.ops.gather import AT_LEAST, Taps, check_taps
from mmpi_ns.ops.layout import dense
from mmpi_ns.scene.texels import BRICK


@operation("gpu", check=check_taps)
def note_use(
    rows: Int[Tensor, "U"],
    taps: list[Taps],
    slots: Int[Tensor, "N"],
    weights: Float[Tensor, "R S"],
    errors: Float[Tensor, "R"],
    peak: Float[Tensor, "B"],
    gain: Float[Tensor, "B"] | None,
) -> None:
    """Raises the peaks of bricks to the largest weight of a sample that reads them, and adds weights times errors to
    the gains of the bricks of first texels, in the order of samples.

    Args:
        rows: of the tables, each once and rising.
        taps: of the samples, those on planes first; positions are among ``rows``.
        slots: flat slot of each sample in ``weights``.
        weights: of the samples.
        errors: of the rays.
        peak: of the bricks, changed in place.
        gain: likewise; None: is not recorded.
    """
    of_samples, sizes = weights.reshape(-1)[slots], [len(each.positions) for each in taps]
    for each, weight in zip(taps, of_samples.split(sizes), strict=True):
        bricks = (rows // BRICK)[each.positions.reshape(-1)]
        peak.scatter_reduce_(0, bricks, weight.repeat_interleave(each.positions.shape[1]), "amax")
    if gain is not None:
        shares = of_samples * errors[slots // weights.shape[1]]
        for each, share in zip(taps, shares.split(sizes), strict=True):
            gain.index_add_(0, rows[each.positions[:, 0]] // BRICK, share)


@note_use.on_cpu
def note_use_on_cpu(
    rows: Tensor, taps: list[Taps], slots: Tensor, weights: Tensor, errors: Tensor, peak: Tensor, gain: Tensor | None
) -> None:
    (rows, slots), of_rays = dense(rows, slots, dtype=torch.int64), dense(weights, errors)
    for each, here in zip(taps, slots.split([len(each.positions) for each in taps]), strict=True):
        first, *inner, last = owned_bounds([each.positions], len(rows), AT_LEAST)
        bounds = [first, *torch.searchsorted(rows, rows[inner] // BRICK * BRICK).tolist(), last]  # divide no brick
        samples = (each.positions.to(torch.int32).contiguous(), *each.positions.shape, here)
        call_in_parts("mmpi_note_use", bounds, rows, *samples, *of_rays, weights.shape[1], peak, gain)
