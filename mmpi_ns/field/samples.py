"""Lookups of merged samples in the field's tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.ops.gather import Taps
from mmpi_ns.ops.interpolate import weigh_rows


@dataclass(frozen=True)
class Lookup:
    """Lookups of the valid samples of a merged batch in the tables. Samples are ordered by head, then by slot.

    Every row that the batch reads is taken from its table once: ``density`` and ``features`` are what the samples read,
    and their gradients are those of the tables (``ops.interpolate.Table``).
    """

    shape: torch.Size
    """(R, S) of the batch."""
    index: Int[Tensor, "N"]
    """Flat slots of the samples."""
    heads: Int[Tensor, "N"]
    planes: Int[Tensor, "N"]
    ndc: Float[Tensor, "N 3"]
    spans: list[tuple[int, slice]]
    """(head, its samples) for every head that occurs."""
    taps: list[Taps]
    """Of the samples of all MPIs together, then of those of the cube; positions are among ``rows``."""
    rows: Int[Tensor, "U"]
    """Distinct rows of the tables, rising."""
    density: Float[Tensor, "U 1"]
    features: Float[Tensor, "U C"]

    @property
    def rays(self) -> Int[Tensor, "N"]:
        return self.index // self.shape[1]

    def read(self, values: Float[Tensor, "U C"]) -> Float[Tensor, "N C"]:
        """Interpolated values of the samples, from those of the rows."""
        parts = [weigh_rows(values, taps.positions, taps.weights) for taps in self.taps]
        return torch.cat(parts) if parts else values.new_zeros(0, values.shape[1])

    def by_head(self, values: Float[Tensor, "N *C"]) -> Iterator[tuple[int, slice, Tensor]]:
        """(head, its samples, their values) for every head that occurs."""
        # Split, not sliced: the gradient of a slice is as large as the whole.
        parts = values.split([samples.stop - samples.start for _, samples in self.spans])
        return ((k, samples, part) for (k, samples), part in zip(self.spans, parts, strict=True))
