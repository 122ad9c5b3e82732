"""Random draws keyed on (seed, step, purpose): a resumed run draws what an uninterrupted one would."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Int
from torch import Tensor


def generator(seed: int, step: int, purpose: str, device: str | torch.device = "cpu") -> torch.Generator:
    """A generator whose stream depends on the three keys alone."""
    return torch.Generator(device=device).manual_seed(_key(seed, step, purpose))


def random_numbers(below: int, count: int, generators: Sequence[torch.Generator]) -> Int[Tensor, "N"]:
    """``count`` random numbers from 0 to ``below`` of each generator."""
    return torch.cat([torch.randint(below, (count,), generator=g, device=g.device) for g in generators])


def _key(seed: int, step: int, purpose: str) -> int:
    digest = hashlib.blake2b(f"{seed}/{step}/{purpose}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


@dataclass(eq=False)
class Generators:
    """The streams of ``generator``, from one object for each purpose, so that a CUDA graph can draw from them
    repeatedly.

    The generators of a graph are seeded by ``start`` before each replay.
    """

    seed: int
    device: str | torch.device
    held: dict[str, torch.Generator] = field(default_factory=dict)
    recording: bool = False
    """Whether steps are being recorded: generators are not seeded then."""

    def of(self, step: int, purpose: str) -> torch.Generator:
        """The stream of a step and a purpose, from its start."""
        g = self.held.setdefault(purpose, torch.Generator(device=self.device))
        return g if self.recording else g.manual_seed(_key(self.seed, step, purpose))

    def start(self, step: int) -> None:
        """Starts the streams of a step."""
        for purpose in self.held:
            self.of(step, purpose)
