"""Merged samples: what the sampler knows about them and where the field looks them up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RaySamples
from torch import Tensor

from mmpi_ns import geometry


@dataclass(frozen=True)
class Lookup:
    """Where the valid samples of a merged batch read the tables."""

    shape: torch.Size
    """(R, S) of the batch."""
    index: Int[Tensor, "N"]
    """Flat slots of the valid samples."""
    heads: Int[Tensor, "N"]
    planes: Int[Tensor, "N"]
    ndc: Float[Tensor, "N 3"]
    groups: list[Any]
    """(rows, weights, members): all MPI samples ordered by head, then the cube's; members index the N samples."""

    def split(self, members: Int[Tensor, "M"]) -> list[tuple[int, Int[Tensor, "P"]]]:
        """(head, positions within ``members``), in the order of ``members``."""
        return by_head(self.heads[members])

    def of_rays(self, chosen: Bool[Tensor, "R"]) -> Lookup:
        """The same samples, with lookups for the chosen rays only."""
        if bool(chosen.all()):
            return self
        wanted = chosen[self.index // self.shape[1]]
        groups = [tuple(part[wanted[group[2]]] for part in group) for group in self.groups]
        return replace(self, groups=groups)


@dataclass(frozen=True)
class LocalRays:
    """R rays in world axes and in every MPI's axes."""

    origins: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    local_origins: Float[Tensor, "R K 3"]
    local_directions: Float[Tensor, "R K 3"]

    @staticmethod
    def of(origins: Tensor, directions: Tensor, frames: geometry.Frames) -> LocalRays:
        return LocalRays(origins, directions, *geometry.rays_in_frames(origins, directions, frames))

    def table(self, k: int) -> Float[Tensor, "R 6"]:
        """Origins and directions in MPI k, or in the world for the cube behind the last MPI."""
        if k < self.local_origins.shape[1]:
            return torch.cat([self.local_origins[:, k], self.local_directions[:, k]], -1)
        return torch.cat([self.origins, self.directions], -1)


def metadata_of(ray_samples: RaySamples) -> dict[str, Tensor]:
    """What the sampler knows about each merged sample (see ``MMPISampler``)."""
    assert ray_samples.metadata is not None, "these samples do not come from MMPISampler"
    return ray_samples.metadata


def by_head(heads: Int[Tensor, "N"]) -> list[tuple[int, Int[Tensor, "M"]]]:
    """(head, indices of its samples) for every head that occurs."""
    if not heads.numel():
        return []
    return [(k, index) for k in range(int(heads.max()) + 1) if (index := (heads == k).nonzero()[:, 0]).numel()]
