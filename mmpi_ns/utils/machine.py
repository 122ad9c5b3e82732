"""What the machine has left to give, and what a process keeps of it."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

CGROUP = Path("/sys/fs/cgroup")

KEPT = 256 << 20
"""Bytes that are freed and kept for the next use: more than a step takes beside the tables."""
OWN_MAPPING = 32 << 20
"""Arrays of so many bytes, which tables are, go back to the system at once: glibc's upper limit."""


def keep_freed_memory() -> bool:
    """Has glibc keep what a training step frees for the next one, which takes the same again.

    Else it gives much of it back to the system, which then hands out zeroed pages: thousands of page faults a step.

    Returns:
        Whether it does so: other C libraries are left as they are.
    """
    trim_threshold, mmap_threshold = -1, -3  # malloc.h
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(trim_threshold, KEPT)) and bool(mallopt(mmap_threshold, OWN_MAPPING))


def give_back_freed_memory() -> None:
    """Has glibc give back what it keeps and nobody uses: before tables grow, which do not fit into what steps leave."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):  # another C library
        return


def lazy_zeros(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Zeros that take no memory on a CPU until they are written to (torch's are written at once)."""
    if device.type != "cpu":
        return torch.zeros(shape, dtype=dtype, device=device)
    return torch.from_numpy(np.zeros((*shape, dtype.itemsize), dtype=np.uint8)).view(dtype).squeeze(-1)


def free_memory(device: str | torch.device) -> int:
    """Bytes that this process can still take on a device: of the machine, its container, and its own limits."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    left = [_available()]
    try:
        left.append(int((CGROUP / "memory.max").read_text()) - int((CGROUP / "memory.current").read_text()))
    except (OSError, ValueError):  # no container, or one without a limit
        pass
    if sys.platform == "linux":
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            left.append(limit - used)
    return max(0, min(left))


def _available() -> int:
    """Bytes that the system says it can give without swapping; all there are where it does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return sys.maxsize
