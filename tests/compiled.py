"""What the tests of compiled operations on a CPU share."""

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


def both(work):
    """What ``work`` returns by the compiled operations and by plain torch."""
    fast = work()
    with dispatch.chosen("torch"):
        return fast, work()


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))
