"""Processes that share the windows of a long capture: one with fewer of them waits for the others."""

from __future__ import annotations

from datetime import timedelta

import torch.distributed as dist

PATIENCE = timedelta(days=7)
"""nerfstudio's processes time out half an hour after the first of them has finished."""


def patient_group() -> dist.ProcessGroup | None:
    """A process group of all processes without time limit; called by all of them.

    None if there is one process, and under torchrun, where ``scripts.train`` waits.
    """
    if not dist.is_initialized() or dist.get_backend() == "gloo":
        return None
    group = dist.new_group(backend="gloo", timeout=PATIENCE)
    assert isinstance(group, dist.ProcessGroup)
    return group


def wait_for_all(group: dist.ProcessGroup | None) -> None:
    """Waits until all processes have called this."""
    if group is not None:
        dist.barrier(group=group)
