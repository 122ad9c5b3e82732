"""Runs a module of the benchmarks in a process of its own: memory, threads and crashes are then its alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mmpi_ns.bench.provenance import read_json

PROGRESS = "@ "
"""Lines that start so are shown while it runs."""


def run_apart(
    module: str,
    request: dict[str, Any],
    folder: Path,
    threads: int,
    seconds: float | None = None,
    extra: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Calls ``python -m module`` with a request.

    Args:
        module: one that ends with ``answer(...)``.
        request: what it is asked.
        folder: where request, answer and everything that it prints (output.log) go.
        threads: of its arithmetic.
        seconds: after which it is ended; None: never.
        extra: variables of its environment.

    Returns:
        Its answer, or why there is none (``not_run``): one that fails is no reason to lose the others.
    """
    folder.mkdir(parents=True, exist_ok=True)
    source, target, log = folder / "request.json", folder / "answer.json", folder / "output.log"
    target.unlink(missing_ok=True)
    source.write_text(json.dumps(request, indent=1), encoding="utf-8")
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": str(threads), **(extra or {})}
    last = ""
    with (
        log.open("w", encoding="utf-8") as stream,
        subprocess.Popen(
            [sys.executable, "-m", module, str(source), str(target)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            text=True,
            errors="replace",
        ) as process,
    ):
        assert process.stdout is not None
        alarm = threading.Timer(seconds, process.kill) if seconds is not None else None
        if alarm is not None:
            alarm.start()
        for line in process.stdout:
            stream.write(line)
            if line.startswith(PROGRESS):
                print(f"    {line[len(PROGRESS) :].rstrip()}", flush=True)
            last = line.strip() or last
        process.wait()
        if alarm is not None:
            alarm.cancel()
    if process.returncode or not target.is_file():
        return {"not_run": f"it failed with status {process.returncode} ({last[:300]}); see {log}"}
    return read_json(target)


def answer(work: Callable[[dict[str, Any], Callable[[str], None]], dict[str, Any]]) -> None:
    """The other end: does the work that the command line names, and writes what it returns.

    Args:
        work: from a request and a way to tell of progress to the answer.
    """
    source, target = (Path(p) for p in sys.argv[1:3])
    found = work(json.loads(source.read_text(encoding="utf-8")), lambda text: print(f"{PROGRESS}{text}", flush=True))
    target.write_text(json.dumps(found), encoding="utf-8")
