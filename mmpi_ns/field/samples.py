"""Merged samples: their data from the sampler and their lookups in the field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RaySamples
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import Places


@dataclass(frozen=True)
class Taps:
    """Texels that a range of samples reads: 4 each in the MPIs, 8 in the cube."""

    samples: slice
    rows: Int[Tensor, "N B"]
    weights: Float[Tensor, "N B"]
    position: Int[Tensor, "N B"] | None = None
    """Index of each row among the batch's distinct rows, if gradients are needed."""


@dataclass(frozen=True)
class Gathered:
    """The distinct rows that a batch reads. Gradients are summed here, so that each row has one."""

    rows: Int[Tensor, "U"]
    density: Float[Tensor, "U 1"]
    features: Float[Tensor, "U C"]


@dataclass(frozen=True)
class Lookup:
    """Lookups of the valid samples of a merged batch in the tables. Samples are ordered by head, then by slot."""

    shape: torch.Size
    """(R, S) of the batch."""
    index: Int[Tensor, "N"]
    """Flat slots of the samples."""
    heads: Int[Tensor, "N"]
    planes: Int[Tensor, "N"]
    ndc: Float[Tensor, "N 3"]
    spans: list[tuple[int, slice]]
    """(head, its samples) for every head that occurs."""
    groups: list[Taps]
    """All MPIs together, then the cube."""
    gathered: Gathered | None
    """Rows read by the groups, if gradients are needed."""

    @property
    def rays(self) -> Int[Tensor, "N"]:
        return self.index // self.shape[1]

    def of_rays(self, chosen: Bool[Tensor, "R"]) -> Lookup:
        """The samples of the chosen rays, or of all rays if choosing would synchronise with a GPU. Gathered rows are
        still those of all rays."""
        if dispatch.on_device(chosen) or bool(chosen.all()):
            return self
        wanted = chosen[self.rays].nonzero()[:, 0]
        heads = self.heads[wanted]
        bounds = torch.searchsorted(wanted, torch.tensor([g.samples.stop for g in self.groups], device=wanted.device))
        groups, start = [], 0
        for taps, stop in zip(self.groups, bounds.tolist(), strict=True):
            own = wanted[start:stop] - taps.samples.start
            position = None if taps.position is None else taps.position.index_select(0, own)
            rows, weights = taps.rows.index_select(0, own), taps.weights.index_select(0, own)
            groups.append(Taps(slice(start, stop), rows, weights, position))
            start = stop
        samples = (self.index[wanted], heads, self.planes[wanted], self.ndc.index_select(0, wanted))
        spans = head_spans(torch.bincount(heads).tolist())
        return Lookup(self.shape, *samples, spans, groups, self.gathered)


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


def by_head(
    heads: Int[Tensor, "R S"], valid: Bool[Tensor, "R S"], num_heads: int, counts: Sequence[int] | None
) -> tuple[Int[Tensor, "N"], Sequence[int]]:
    """Flat slots of the valid samples, heads rising and otherwise in order, and how many each head has.

    Args:
        heads: of every slot.
        valid: which slots hold a sample.
        num_heads: of the scene.
        counts: samples of each head, if known; otherwise this synchronises with a GPU.
    """
    if counts is not None:
        keys = torch.where(valid, heads, num_heads).reshape(-1)
        return torch.sort(keys.to(torch.int16), stable=True).indices[: sum(counts)], counts
    index = valid.reshape(-1).nonzero()[:, 0]
    own = heads.reshape(-1)[index]
    parts = [(own == k).nonzero()[:, 0] for k in range(num_heads)]  # on a CPU a sort takes longer
    return index[torch.cat(parts)], [len(p) for p in parts]
