"""What all benchmarks share: options of a scene, nerfstudio's commands as a user types them, and figures."""

from __future__ import annotations

import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from apart import environment_of
from report import Row, commit, processor, read_json
from trainers import Scene, clock

import mmpi_priors.ops
from mmpi_ns.ops import build
from mmpi_ns.utils.files import cache_folder


def median_s(work: Callable[[], Any], repeats: int) -> float:
    """Median seconds, the device waited for, after a call that is not timed (it may compile)."""
    work()
    times = []
    for _ in range(repeats):
        start = clock()
        work()
        times.append(clock() - start)
    return statistics.median(times)


@dataclass(frozen=True)
class Used:
    """What a command took."""

    seconds: float
    """By the clock."""
    processor_seconds: float
    gib: float
    """Most memory of its process."""


def run_command(words: list[str], log: Path, threads: int, **variables: str) -> Used:
    """Runs a command to its end, with some variables of its environment; what it prints goes to a log.

    Raises:
        ValueError: it failed; names the log.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            words, stdout=stream, stderr=subprocess.STDOUT, env=environment_of(threads) | variables
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise ValueError(f"{Path(words[0]).name} failed with status {process.returncode}: see {log}.")
    return Used(time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 2**20)


def train_and_evaluate(
    scene: Scene,
    folder: Path,
    method: str,
    options: Sequence[str],
    asked: Sequence[str],
    threads: int,
    resumes: bool = False,
) -> tuple[Path, dict[str, Any], dict[str, Any]]:
    """``ns-train`` with some options, and ``ns-eval`` with what is asked, as a user types them; logs are in the folder.

    The cache is empty but for the compiled operations, so that priors are computed. An interrupted training is deleted,
    or ``resumes`` from its last checkpoint; what it took is not known then.

    Returns:
        The run's folder, the results of ns-eval, and for the row: what training took, threads, machine and commit.
    """
    train, evaluate = (str(Path(sys.executable).with_name(name)) for name in ("ns-train", "ns-eval"))
    place = ["--output-dir", str(folder), "--experiment-name", "run", "--timestamp", "1", "--vis", "tensorboard"]
    size = ["--data", str(scene.data), "nerfstudio-data", "--downscale-factor", str(scene.downscale_factor)]
    run, results = folder / "run" / method / "1", folder / "eval.json"
    checkpoints = run / "nerfstudio_models"
    resumed = resumes and checkpoints.is_dir() and any(checkpoints.iterdir())
    if resumed:
        place += ["--load-dir", str(checkpoints)]
    else:
        shutil.rmtree(run, ignore_errors=True)
    with TemporaryDirectory() as cache:
        for operations in (build.OPS, Path(mmpi_priors.ops.__file__).parent):
            build.library(operations)
            library = build.library_file(operations)
            copied = Path(cache, cache_folder().name, library.name)
            copied.parent.mkdir(exist_ok=True)
            copied.symlink_to(library)
        command = [train, method, *place, *options, *size]
        used = run_command(command, folder / "train.log", threads, XDG_CACHE_HOME=cache)
    words = [evaluate, "--load-config", str(run / "config.yml"), "--output-path", str(results), *asked]
    run_command(words, folder / "eval.log", threads)
    took = {"train_seconds": used.seconds, "processor_seconds": used.processor_seconds, "gib": used.gib}
    made = ({} if resumed else took) | {"threads": threads, "processor": processor(), "commit": commit()}
    return run, read_json(results)["results"], made | {"date": date.today().isoformat()}


def end_helpers(trainer: Any) -> None:
    """Ends the processes that prepare nerfacto's batches."""
    for process in getattr(trainer.pipeline.datamanager, "data_procs", []):
        process.terminate()


def peak_gib() -> float:
    """Most memory that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def not_run(rows: Mapping[str, Row]) -> str:
    """A list of what did not run, with the reasons; each once."""
    lines = dict.fromkeys(f"- {r.get('what', name)}: {r['not_run']}." for name, r in rows.items() if "not_run" in r)
    return "\n".join(["Not run:", "", *lines]) if lines else ""


@contextmanager
def figure(path: Path, rows: int, columns: int, size: tuple[float, float], **how: Any) -> Iterator[Any]:
    """Axes [rows, columns] to draw on; written when the block ends, with grids, and legends where there are labels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(drawing)
    axes = drawing.subplots(rows, columns, squeeze=False, **how)
    yield axes
    for axis in axes.flat:
        axis.grid(alpha=0.3)
        if axis.get_legend() is None and axis.get_legend_handles_labels()[1]:
            axis.legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=110)
