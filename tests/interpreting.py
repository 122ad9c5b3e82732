"""What the tests of Triton kernels by its interpreter share."""

from __future__ import annotations

import pytest
import torch

from mmpi_ns.ops import native


@pytest.fixture(autouse=True)
def interpreted(monkeypatch):
    """Every test runs on the kernels; one that silently took plain torch would test nothing."""
    monkeypatch.setattr(native, "_chosen", "auto")
    native.interpret(True)
    assert native.takes_triton(torch.zeros(1)) and native.library(torch.zeros(1)) is None
    yield
    native.interpret(False)


def by_torch(work):
    """What ``work`` returns by plain torch."""
    native.choose("torch")
    try:
        return work()
    finally:
        native.choose("auto")


def normal(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)
