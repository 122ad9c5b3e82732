"""Merged samples: their data from the sampler and their lookups in the field."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RaySamples
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.gather import Taps
from mmpi_ns.ops.interpolate import weigh_rows
from mmpi_ns.ops.layout import Places


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

    def of_rays(self, chosen: Bool[Tensor, "R"]) -> Lookup:
        """The samples of the chosen rays, or of all rays if choosing would synchronise with a GPU. Rows are still those
        of all rays."""
        if dispatch.on_device(chosen) or bool(chosen.all()):
            return self
        samples = chosen[self.rays].nonzero()[:, 0]
        ends = torch.tensor([*accumulate(len(taps.positions) for taps in self.taps)])
        bounds, taps = [0, *torch.searchsorted(samples, ends).tolist()], []
        for each, end, (a, b) in zip(self.taps, ends.tolist(), pairwise(bounds), strict=True):
            chosen_taps = samples[a:b] - (end - len(each.positions))
            taps.append(Taps(*(x.index_select(0, chosen_taps) for x in (each.positions, each.weights))))
        heads = self.heads[samples]
        return replace(
            self,
            index=self.index[samples],
            heads=heads,
            planes=self.planes[samples],
            ndc=self.ndc.index_select(0, samples),
            spans=head_spans(torch.bincount(heads).tolist()),
            taps=taps,
        )


def head_spans(counts: Sequence[int]) -> list[tuple[int, slice]]:
    """(head, range of its samples) for every head that occurs among samples ordered by head."""
    ends = list(accumulate(counts))
    return [(k, slice(end - n, end)) for k, (n, end) in enumerate(zip(counts, ends, strict=True)) if n]


def metadata_of(ray_samples: RaySamples) -> dict[str, Tensor]:
    """Data of each merged sample from the sampler (see ``MMPISampler``)."""
    assert ray_samples.metadata is not None, "these samples do not come from MMPISampler"
    return ray_samples.metadata


def places_of(ray_samples: RaySamples) -> Places:
    """Positions of merged samples."""
    meta = metadata_of(ray_samples)
    return Places(meta["heads"][..., 0], meta["planes"][..., 0], meta["ndc"], meta["valid"][..., 0])
