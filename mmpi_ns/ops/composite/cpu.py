"""Volume rendering of merged samples, compiled: ``composite.cpp``."""

from __future__ import annotations

from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.composite import Composite, composited


def composite_weights(tau: Tensor, valid: Tensor, skipped_before: Tensor, skipped_total: Tensor) -> Composite:
    rays, slots = tau.shape

    def run(name: str, *tensors: Tensor) -> None:
        call_in_parts(f"mmpi_{name}", rays, slots, *tensors)

    return composited(run, tau, valid, skipped_before, skipped_total)
