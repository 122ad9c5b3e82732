"""Processor, free memory and cores of the machine, and a GPU that torch does not use."""

from __future__ import annotations

import os
import platform
import re
import sys
import time
from pathlib import Path

import torch

CGROUP = Path("/sys/fs/cgroup")
STAT = Path("/proc/stat")
NVIDIA = Path("/proc/driver/nvidia")
DRIVERS = {13: 580, 12: 525, 11: 450}
"""Series of NVIDIA's driver that a major version of CUDA needs at least."""
WHEELS = {12: "cu126", 11: "cu118"}
"""Builds of torch for CUDA versions of older drivers."""


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
    if sys.platform == "linux":
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            left.append(limit - used)
    return max(0, min(left))


def free_cores(seconds: float = 0.2) -> float:
    """Idle cores among those that this process may use, observed for ``seconds``."""
    most = float(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    try:
        quota, period = (CGROUP / "cpu.max").read_text(encoding="ascii").split()
        most = min(most, int(quota) / int(period))
    except (OSError, ValueError):  # no container, or one without a limit
        pass
    try:
        before = _idle_ticks()
        time.sleep(seconds)
        idle = (_idle_ticks() - before) / os.sysconf("SC_CLK_TCK") / seconds
    except (OSError, ValueError):  # not Linux
        return most
    return max(0.0, min(most, idle))


def _idle_ticks() -> int:
    """Ticks in which cores were idle or waited for a disk, since the start of the system."""
    return sum(int(word) for word in STAT.read_text(encoding="ascii").split("\n", 1)[0].split()[4:6])


def unused_gpu() -> str:
    """Reason why torch does not use an NVIDIA GPU of the system, with the command to fix it; empty if it does, if there
    is none, and if CUDA_VISIBLE_DEVICES hides it."""
    if torch.cuda.is_available() or os.environ.get("CUDA_VISIBLE_DEVICES") is not None:
        return ""
    try:
        gpus = [path.read_text(encoding="utf-8") for path in (NVIDIA / "gpus").glob("*/information")]
        version = re.search(r"\b(\d{3})\.\d+(\.\d+)?\b", (NVIDIA / "version").read_text(encoding="utf-8"))
    except OSError:
        return ""
    if not gpus or version is None:
        return ""
    model = re.search(r"Model:\s*(.+)", gpus[0])
    where = f"this machine has {model[1].strip() if model else 'an NVIDIA GPU'} with driver {version[0]}"
    driver, cuda = int(version[1]), int((torch.version.cuda or "0").split(".")[0])
    wheel = next((WHEELS[c] for c in WHEELS if driver >= DRIVERS[c]), None)
    pip = f"pip install --force-reinstall torch torchvision --index-url https://download.pytorch.org/whl/{wheel}"
    if driver >= DRIVERS.get(cuda, 0) > 0:
        return f"{where}, but CUDA does not start: python -c 'import torch; torch.cuda.init()' says why"
    why = f"needs {DRIVERS[cuda]} or newer" if cuda in DRIVERS else "is built without CUDA"
    mends = pip if wheel else "update the driver"
    return f"{where}, and torch {torch.__version__} {why}; to use it: {mends}"


def processor() -> str:
    """Cores and model of this machine's CPU."""
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.is_file() else ""
    names = re.findall(r"model name\s*: (.*)", text)
    return f"{os.cpu_count()} cores of {names[0] if names else platform.processor()}"
