"""Processor and free memory of the machine, and a GPU that torch does not use."""

from __future__ import annotations

import os
import platform
import re
import sys
from pathlib import Path

import torch

CGROUP = Path("/sys/fs/cgroup")
NVIDIA = Path("/proc/driver/nvidia")


def free_memory(device: str | torch.device) -> int:
    """Bytes that this process can still take on a device: of the machine, its container, and its own limits."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    left = [sys.maxsize]
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        left += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    except OSError:  # not Linux
        pass
    try:
        left.append(int((CGROUP / "memory.max").read_text()) - int((CGROUP / "memory.current").read_text()))
    except (OSError, ValueError):  # no container, or one without a limit
        pass
    return max(0, min(left))


def unused_gpu() -> str:
    """A sentence for an NVIDIA GPU of the system that torch does not see; empty if there is none, if torch sees it, and
    if CUDA_VISIBLE_DEVICES hides it."""
    if torch.cuda.is_available() or os.environ.get("CUDA_VISIBLE_DEVICES") is not None:
        return ""
    if not list((NVIDIA / "gpus").glob("*/information")):
        return ""
    return (
        f"torch {torch.__version__} does not see this machine's NVIDIA GPU: python -c 'import torch; "
        "torch.cuda.init()' says why, and docs/gpu.md which build of torch a driver needs"
    )


def processor() -> str:
    """Cores and model of this machine's CPU, and whether it has AVX-512: of one name, those without are far slower."""
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.is_file() else ""
    names = re.findall(r"model name\s*: (.*)", text)
    wide = " with AVX-512" if "avx512f" in text else ""
    return f"{os.cpu_count()} cores of {names[0] if names else platform.processor()}{wide}"
