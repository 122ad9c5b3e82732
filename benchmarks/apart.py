"""Calls a function of the benchmarks in a process of its own: memory, threads and crashes are then its alone."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from report import read_json

Tell = Callable[[str], None]
"""Says how far it is."""
Work = Callable[[dict[str, Any], Tell], dict[str, Any]]
"""A function at the top of a module, from a request that JSON can hold to such an answer."""
PROGRESS = "@ "
"""Lines that start so are shown while it runs."""


def run_apart(
    work: Work,
    request: dict[str, Any],
    folder: Path,
    threads: int,
    seconds: float | None = None,
    extra: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """``work(request, tell)`` in a fresh process.

    Args:
        work: the function.
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
    module = work.__module__
    if module == "__main__":  # of a script, which the other process imports by its name
        module = Path(sys.modules["__main__"].__file__ or "").stem
    environment = {**environment_of(threads), "PYTHONPATH": os.pathsep.join(sys.path), **(extra or {})}
    words = [sys.executable, str(Path(__file__).resolve()), module, work.__qualname__, str(source), str(target)]
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    last = ""
    with (
        log.open("w", encoding="utf-8") as stream,
        subprocess.Popen(words, **pipes, env=environment, text=True, errors="replace") as process,
    ):
        assert process.stdout is not None
        alarm = threading.Timer(seconds or 0.0, process.kill)
        if seconds is not None:
            alarm.start()
        for line in process.stdout:
            stream.write(line)
            if line.startswith(PROGRESS):
                print(f"    {line[len(PROGRESS) :].rstrip()}", flush=True)
            last = line.strip() or last
        process.wait()
        alarm.cancel()
    if process.returncode or not target.is_file():
        return {"not_run": f"it failed with status {process.returncode} ({last[:300]}); see {log}"}
    return read_json(target)


def environment_of(threads: int) -> dict[str, str]:
    """This process' variables for one of so many threads."""
    return {**os.environ, "OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": str(threads)}


def main(module: str, function: str, source: str, target: str) -> None:
    """The other end: does the work and writes what it returns."""
    work: Work = getattr(importlib.import_module(module), function)
    results = work(read_json(Path(source)), lambda text: print(f"{PROGRESS}{text}", flush=True))
    Path(target).write_text(json.dumps(results), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
