"""Where a figure was measured: processor and commit."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from pathlib import Path


def processor() -> str:
    """Cores and model of this machine's CPU."""
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.is_file() else ""
    names = re.findall(r"model name\s*: (.*)", text)
    return f"{os.cpu_count()} cores of {names[0] if names else platform.processor()}"


def commit() -> str:
    """Short hash of the commit that this package is checked out at; "unknown" where it is installed."""
    words = ["git", "-C", str(Path(__file__).resolve().parent), "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip() or "unknown"
