"""How many rays are rendered at once."""

from __future__ import annotations

import pytest
import torch

from mmpi_ns.rendering.images import (
    BYTES_PER_SAMPLE,
    CPU_RAYS,
    FREE_SHARE,
    GPU_RAYS,
    rays_per_chunk,
)

GIB = 2**30


@pytest.mark.parametrize("free", [0.5, 2.0, 7.0, 24.0])
@pytest.mark.parametrize("samples", [64, 256, 1024])
def test_a_gpu_renders_what_half_of_its_free_memory_holds(monkeypatch, free, samples):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(free * GIB), 80 * GIB))
    for name in ("memory_reserved", "memory_allocated"):
        monkeypatch.setattr(torch.cuda, name, lambda device: GIB)
    found = rays_per_chunk(samples, torch.device("cuda", 0))
    room = FREE_SHARE * free * GIB / (BYTES_PER_SAMPLE * samples)
    assert found == GPU_RAYS or found == CPU_RAYS or found <= room < 2 * found
    assert found > CPU_RAYS or room < 2 * CPU_RAYS
    assert found < GPU_RAYS or room >= GPU_RAYS
