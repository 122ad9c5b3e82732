"""What rays gather of the texels along them: sums of rendering weight times colour and features."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from mmpi_ns.ops import native
from mmpi_ns.ops.gather import cpu, reference
from mmpi_ns.ops.gather.reference import COLORS, KnownTaps, RaySums

__all__ = ["COLORS", "KnownTaps", "RaySums", "gather_places", "gather_taps"]


def _form(*tensors: Tensor) -> Any:
    return reference if native.library(*tensors) is None else cpu


def gather_taps(values: Tensor, groups: list[KnownTaps], slots: Tensor, weights: Tensor, wanted: Tensor) -> RaySums:
    """See ``reference.gather_taps``."""
    return _form(values, weights).gather_taps(values, groups, slots, weights, wanted)


def gather_places(
    grids: list[Any], num_mpis: int, table: Tensor, heads: Tensor, planes: Tensor, ndc: Tensor, valid: Tensor,
    weights: Tensor,
) -> RaySums:  # fmt: skip
    """See ``reference.gather_places``."""
    return _form(table, ndc, weights).gather_places(grids, num_mpis, table, heads, planes, ndc, valid, weights)
