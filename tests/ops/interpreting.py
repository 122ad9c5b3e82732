"""What the tests of Triton kernels by its interpreter share."""

from __future__ import annotations

import pytest
import torch
from gpu_parts import interpret

from mmpi_ns.ops import dispatch
from mmpi_ns.sampler import march


@pytest.fixture(autouse=True)
def interpreted(monkeypatch):
    """Every test runs on the kernels; one that silently took plain torch would test nothing."""
    monkeypatch.setattr(dispatch, "_chosen", "auto")
    interpret(True)
    assert dispatch.form_of(march.name, torch.zeros(1)) == "gpu"
    yield
    interpret(False)
