"""What rays gather of the texels along them: sums of rendering weight times colour and features."""

from __future__ import annotations

from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.gather.reference import COLORS, KnownTaps, RaySums
from mmpi_ns.ops.layout import SceneLayout

__all__ = ["COLORS", "KnownTaps", "RaySums", "gather_places", "gather_taps"]


def gather_taps(values: Tensor, groups: list[KnownTaps], slots: Tensor, weights: Tensor, wanted: Tensor) -> RaySums:
    """See ``reference.gather_taps``."""
    return dispatch.run("gather_taps", values, groups, slots, weights, wanted)


def gather_places(
    layout: SceneLayout, table: Tensor, heads: Tensor, planes: Tensor, ndc: Tensor, valid: Tensor, weights: Tensor
) -> RaySums:
    """See ``reference.gather_places``."""
    return dispatch.run("gather_places", layout, table, heads, planes, ndc, valid, weights)
