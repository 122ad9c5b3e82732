"""What rays gather of the texels along them: sums of rendering weight times colour and features."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.gather.reference import COLORS, KnownTaps, RaySums, gather_places

__all__ = ["COLORS", "KnownTaps", "RaySums", "gather_places", "gather_taps"]


def gather_taps(
    values: Float[Tensor, "U C"],
    groups: list[KnownTaps],
    slots: Int[Tensor, "N"],
    weights: Float[Tensor, "R S"],
    wanted: Bool[Tensor, "R"],
) -> RaySums:
    """Sums over samples whose taps are known, with gradients to ``values``, ``weights`` and the taps' shares.

    Args:
        values: texels that the batch reads.
        groups: taps of the samples, those of planes first.
        slots: flat slot of each sample in ``weights``.
        weights: rendering weights.
        wanted: the rays to sum for; the others get 0.
    """
    return dispatch.run("gather_taps", values, groups, slots, weights, wanted)
