"""Calls a function of the benchmarks in a process of its own: memory, threads and crashes are then its alone."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from mmpi_ns.bench.report import Scene, commit, processor, read_json

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
    environment = {**environment_of(threads), **(extra or {})}
    words = [sys.executable, "-m", "mmpi_ns.bench.apart", work.__module__, work.__qualname__, str(source), str(target)]
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


def run_command(words: list[str], log: Path, threads: int, **how: Any) -> None:
    """Runs a command to its end; what it prints goes to a log.

    Raises:
        ValueError: it failed; names the log.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w", encoding="utf-8") as stream:
        ended = subprocess.run(words, stdout=stream, stderr=subprocess.STDOUT, env=environment_of(threads), **how)
    if ended.returncode:
        raise ValueError(f"{Path(words[0]).name} failed with status {ended.returncode}: see {log}.")


def train_and_evaluate(
    scene: Scene, folder: Path, method: str, options: Sequence[str], asked: Sequence[str], threads: int
) -> tuple[Path, dict[str, Any], dict[str, Any]]:
    """``ns-train`` with some options, and ``ns-eval`` with what is asked, as a user types them; logs are in the folder.

    Returns:
        The run's folder, the results of ns-eval, and for the row: seconds of training, threads, machine and commit.
    """
    train, evaluate = (str(Path(sys.executable).with_name(name)) for name in ("ns-train", "ns-eval"))
    place = ["--output-dir", str(folder), "--experiment-name", "run", "--timestamp", "1", "--vis", "tensorboard"]
    size = ["--data", str(scene.data), "nerfstudio-data", "--downscale-factor", str(scene.downscale_factor)]
    start = time.perf_counter()
    run_command([train, method, *place, *options, *size], folder / "train.log", threads)
    seconds = time.perf_counter() - start
    run, found = folder / "run" / method / "1", folder / "eval.json"
    words = [evaluate, "--load-config", str(run / "config.yml"), "--output-path", str(found), *asked]
    run_command(words, folder / "eval.log", threads)
    made = {"train_seconds": seconds, "threads": threads, "processor": processor(), "commit": commit()}
    return run, read_json(found)["results"], made | {"date": date.today().isoformat()}


def main(module: str, function: str, source: str, target: str) -> None:
    """The other end: does the work and writes what it returns."""
    work: Work = getattr(importlib.import_module(module), function)
    found = work(read_json(Path(source)), lambda text: print(f"{PROGRESS}{text}", flush=True))
    Path(target).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
