"""How many rays are rendered at once."""

from __future__ import annotations

import pytest
import torch

from mmpi_ns.rendering.images import (
    BYTES_PER_SAMPLE,
    CPU_RAYS,
    FREE_SHARE,
    GPU_RAYS,
    SHOWN_RAYS,
    rays_per_chunk,
)

GIB = 2**30


def gpu_with(monkeypatch, free: float, cached: float = 0.0) -> torch.device:
    """A GPU with so much memory that nobody uses, and so much that torch holds for itself, GiB."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(free * GIB), 80 * GIB))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: int((1 + cached) * GIB))
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: GIB)
    return torch.device("cuda", 0)


@pytest.mark.parametrize("samples", [0, 1, 1024])
def test_a_cpu_has_larger_chunks_where_nothing_is_kept(samples):
    assert rays_per_chunk(samples, torch.device("cpu")) == CPU_RAYS
    assert rays_per_chunk(samples, torch.device("cpu"), samples) == SHOWN_RAYS > CPU_RAYS


@pytest.mark.parametrize("free", [0.5, 2.0, 7.0, 24.0])
@pytest.mark.parametrize("samples", [64, 256, 1024])
def test_a_gpu_renders_what_half_of_its_free_memory_holds(monkeypatch, free, samples):
    found = rays_per_chunk(samples, gpu_with(monkeypatch, free))
    room = FREE_SHARE * free * GIB / (BYTES_PER_SAMPLE * samples)
    assert found == GPU_RAYS or found == CPU_RAYS or found <= room < 2 * found
    assert found > CPU_RAYS or room < 2 * CPU_RAYS
    assert found < GPU_RAYS or room >= GPU_RAYS
