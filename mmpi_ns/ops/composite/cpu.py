"""Volume rendering of merged samples, compiled: ``composite.cpp``."""

from __future__ import annotations

from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.composite import Composite, composited


def composite_weights(tau: Tensor, valid: Tensor, skipped_before: Tensor, skipped_total: Tensor) -> Composite:
    return composited(call_in_parts, tau, valid, skipped_before, skipped_total)
