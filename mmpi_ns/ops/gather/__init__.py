"""What rays gather of the texels along them: sums of rendering weight times colour and features."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.gather.reference import COLORS, RaySums, Taps, gather_places
from mmpi_ns.ops.shapes import check_shapes

__all__ = ["COLORS", "RaySums", "Taps", "gather_places", "gather_taps"]


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
    for each in taps:
        check_shapes("positions N B, tap_weights N B", each.positions, each.weights)
    if (sizes := [each.weights.shape[1] for each in taps]) not in ([], [4], [8], [4, 8]):
        raise ValueError(f"taps of {sizes} texels where those of planes have 4, and those of the cube after them 8")
    count = sum(len(each.positions) for each in taps)
    check_shapes("values U C, slots N, weights R S, chosen R", values, slots, weights, chosen, N=count)
    return dispatch.run("gather_taps", values, taps, slots, weights, chosen)
