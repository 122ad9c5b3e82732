"""With what a table was made: command, processor, commit, date. Shared by all benchmarks."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shlex
import subprocess
from dataclasses import MISSING, fields
from datetime import date
from pathlib import Path
from typing import Any

import torch


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


def fingerprint() -> str:
    """Of this package's sources and torch: what was measured with equal ones need not be measured again."""
    package = Path(__file__).resolve().parents[1]
    sources = sorted(p for p in package.rglob("*") if p.suffix in (".py", ".cpp", ".h"))
    digest = hashlib.sha256(torch.__version__.encode())
    for path in sources:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def command_of(name: str, settings: Any) -> str:
    """The ``mmpi-bench`` line that makes these settings (a dataclass): what differs from the defaults."""
    words = ["mmpi-bench", name]
    for f in fields(settings):
        value = getattr(settings, f.name)
        default = f.default_factory() if f.default_factory is not MISSING else f.default
        if value == default:
            continue
        flag = f.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{flag}")
        else:
            words += [f"--{flag}", *(_word(v) for v in (value if isinstance(value, tuple) else (value,)))]
    return shlex.join(words)


def _word(value: Any) -> str:
    """Where a folder lies on this machine is of no interest to others, its name is."""
    return value.name if isinstance(value, Path) and value.is_absolute() else str(value)


def stamp(name: str, settings: Any) -> dict[str, Any]:
    """Provenance of a run that starts now."""
    return {
        "command": command_of(name, settings),
        "processor": processor(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "commit": commit(),
        "date": date.today().isoformat(),
    }


def stamp_line(made: dict[str, Any]) -> str:
    """The same as a sentence for a table."""
    return (
        f"Made by `{made['command']}` on {made['processor']} ({made['threads']} thread(s), torch {made['torch']}), "
        f"commit {made['commit']}, {made['date']}."
    )


def read_json(path: Path) -> dict[str, Any]:
    """What an earlier run left; empty where there is nothing."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, path)
