"""What rays gather of the texels along them: sums of rendering weight times colour and features."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from torch import Tensor

from mmpi_ns.ops import native
from mmpi_ns.ops.gather import cpu, reference
from mmpi_ns.ops.gather.reference import COLORS, KnownTaps, RaySums
from mmpi_ns.scene.texels import TexelGrid

__all__ = ["COLORS", "KnownTaps", "RaySums", "gather_places", "gather_taps"]


def _gpu() -> Any:
    """The form that needs Triton."""
    return importlib.import_module("mmpi_ns.ops.gather.gpu")


def gather_taps(values: Tensor, groups: list[KnownTaps], slots: Tensor, weights: Tensor, wanted: Tensor) -> RaySums:
    """See ``reference.gather_taps``."""
    given = (values, groups, slots, weights, wanted)
    if native.takes_triton(values, weights):
        return _gpu().gather_taps(*given)
    return (reference if native.library(values, weights) is None else cpu).gather_taps(*given)


def gather_places(
    grids: list[TexelGrid],
    num_mpis: int,
    triton_scene: Callable[[], Any],
    table: Tensor,
    heads: Tensor,
    planes: Tensor,
    ndc: Tensor,
    valid: Tensor,
    weights: Tensor,
) -> RaySums:
    """See ``reference.gather_places``; ``triton_scene`` gives the scene as kernels on a GPU take it."""
    given = (table, heads, planes, ndc, valid, weights)
    if native.takes_triton(table, ndc, weights):
        return _gpu().gather_places(triton_scene(), *given)
    form = reference if native.library(table, ndc, weights) is None else cpu
    return form.gather_places(grids, num_mpis, *given)
