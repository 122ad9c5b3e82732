"""Random draws keyed on (seed, step, purpose): a resumed run draws what an uninterrupted one would."""

from __future__ import annotations

import hashlib

import torch


def generator(seed: int, step: int, purpose: str, device: str | torch.device = "cpu") -> torch.Generator:
    """A generator whose stream depends on the three keys alone."""
    digest = hashlib.blake2b(f"{seed}/{step}/{purpose}".encode(), digest_size=8).digest()
    return torch.Generator(device=device).manual_seed(int.from_bytes(digest, "little") >> 1)
