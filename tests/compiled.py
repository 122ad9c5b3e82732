"""What the tests of compiled operations share: of the CPU's, and of Triton kernels by its interpreter."""

from __future__ import annotations

import pytest
import torch

from mmpi_ns.ops import dispatch
from mmpi_ns.sampler import march


@pytest.fixture(autouse=True)
def compiled(monkeypatch):
    """The machine that runs the tests has a compiler: an operation that silently ran in torch would test nothing."""
    monkeypatch.setattr(dispatch, "_chosen", "auto")
    assert dispatch.form_of(march.name, torch.zeros(1)) == "cpu"


@pytest.fixture(autouse=True)
def interpreted(monkeypatch):
    """Every test runs on the kernels; one that silently took plain torch would test nothing."""
    monkeypatch.setattr(dispatch, "_chosen", "auto")
    from gpu_parts import interpret

    interpret(True)
    assert dispatch.form_of(march.name, torch.zeros(1)) == "gpu"
    yield
    interpret(False)


def both(work):
    """What ``work`` returns by the compiled operations and by plain torch."""
    fast = work()
    with dispatch.chosen("torch"):
        return fast, work()


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))
