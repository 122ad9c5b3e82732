"""Processes that share the windows of a long capture: one with fewer of them waits for the others."""

from __future__ import annotations

from datetime import timedelta

import torch.distributed as dist

PATIENCE = timedelta(days=7)
"""nerfstudio's processes give up half an hour after the first of them is through."""


def patient_group() -> dist.ProcessGroup | None:
    """All processes, waiting as long as it takes; called by all of them.

    None where there is one process, and under torchrun, where ``scripts.train`` waits.
    """
    if not dist.is_initialized() or dist.get_backend() == "gloo":
        return None
    group = dist.new_group(backend="gloo", timeout=PATIENCE)
    assert isinstance(group, dist.ProcessGroup)
    return group


def wait_for_all(group: dist.ProcessGroup | None) -> None:
    """Until all processes have called this."""
    if group is not None:
        dist.barrier(group=group)
