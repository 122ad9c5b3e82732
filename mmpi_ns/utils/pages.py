"""Pages of large arrays on a CPU: large ones for tables, none for what is not written, and given back early."""

from __future__ import annotations

import ctypes
import math
import mmap
import sys

import torch
from torch import Tensor

FORGET, LARGE_PAGES = 4, 14
"""Of madvise, in linux/mman.h: MADV_DONTNEED gives memory back, and the values are lost; MADV_HUGEPAGE."""
PART = 1 << 20
"""Number of elements compared at once."""


def lazy_zeros(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Zeros that take no memory on a CPU until they are written to (torch's are written at once)."""
    count = math.prod(shape)
    if device.type != "cpu" or sys.platform == "win32" or not count:
        return torch.zeros(shape, dtype=dtype, device=device)
    # Memory of malloc would be zeroed by hand where it was used before.
    memory = mmap.mmap(-1, count * dtype.itemsize, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return torch.frombuffer(memory, dtype=dtype, count=count).view(shape)


def empty_table(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """An array that is not written yet, in large pages if the system has any: rows that are read at random then need
    fewer of the processor's page tables."""
    table = torch.empty(shape, dtype=dtype, device=device)
    advise(table, LARGE_PAGES)
    return table


def all_zero(array: Tensor) -> bool:
    """Whether all elements are 0, as for reliability in joint training: stops at the first part that has another value,
    without the mask of ``any``."""
    return not any(bool(part.any()) for part in array.reshape(-1).split(PART))


def advise(array: Tensor, advice: int) -> None:
    """madvise for the whole pages of a contiguous array, or of a part of one, on a CPU. Ignored by systems without
    it."""
    if array.device.type != "cpu" or sys.platform != "linux":
        return
    start, page = array.data_ptr(), mmap.PAGESIZE
    first, end = -(-start // page) * page, (start + array.numel() * array.element_size()) // page * page
    if end > first:
        ctypes.CDLL(None).madvise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), advice)
