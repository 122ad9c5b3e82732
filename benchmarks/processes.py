"""What several processes on one machine make of a long capture's windows."""

from __future__ import annotations

import os
import shutil
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lab import run_command
from methods import Method
from report import Bench, Report, Row, page, table

from mmpi_ns.bench.trainers import Scene
from mmpi_ns.config import mmpi_small
from mmpi_ns.placement.split import place_windows
from mmpi_ns.scripts.command import run
from mmpi_ns.scripts.plan import load_observations


@dataclass
class Processes(Bench):
    """Throughput of training in several processes (torchrun, gloo) beside one process that is held to one core.

    Every number of processes trains the same plan twice, for few steps a window and for more: the difference leaves
    out starting, reading, and what else is done once. The windows that come out are compared.
    """

    data: Path
    """A capture long enough for as many windows as processes (a folder with transforms.json)."""
    downscale_factor: int = 2
    """Image size to use."""
    processes: int = 2
    """Processes beside the one; each has one thread."""
    few: int = 40
    """Steps of a window that are taken off."""
    steps: int = 240
    """Steps of a window."""
    threads: int = field(default=1, kw_only=True)
    """Of each process."""

    name = "processes"

    def run(self) -> None:
        report = Report(self, self.key())
        windows = self._plan()
        for count in (1, self.processes):
            row = report.row(str(count), lambda c=count: {str(n): self._train(c, n) for n in (self.few, self.steps)})
            print(f"{count} processes: {row} s", flush=True)
        rows = {int(count): {int(n): s for n, s in row.items()} for count, row in report.rows.items()}
        head = headline(rows, self.processes, windows, self.few, self.steps)
        head["largest_difference"] = self._difference(windows)
        report.finish(head, self._markdown(rows, head, windows, report.content["made"]))
        print(head)

    def _plan(self) -> int:
        """Places MPIs for the steps of the longer run; returns how many windows there are."""
        settings: Any = mmpi_small.config.pipeline
        observations = load_observations(self.data, downscale_factor=self.downscale_factor)[0]
        rays = self.steps * settings.datamanager.train_num_rays_per_batch
        plan = place_windows(observations, settings.model.placement, rays)
        if len(plan) < self.processes:
            raise ValueError(
                f"{self.data} has {len(plan)} window(s), too few for {self.processes} processes: give a longer capture."
            )
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "plan.json").write_text(plan.to_json(), encoding="utf-8")
        return len(plan)

    def _folder(self, count: int, steps: int) -> Path:
        return self.folder / f"{count} of {steps}"

    def _train(self, count: int, steps: int) -> float:
        """Trains all windows; returns seconds by the clock."""
        folder = self._folder(count, steps)
        shutil.rmtree(folder, ignore_errors=True)  # windows that are finished there would not be trained again
        folder.mkdir(parents=True)
        method = Method("road", "mmpi-small", ("--pipeline.model.plan-file", str(self.folder / "plan.json")))
        words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
        words += ["-m", "mmpi_ns.scripts.train"]
        words += method.words(Scene(self.data, self.downscale_factor), folder, steps, None, 0, "cpu")
        core = min(os.sched_getaffinity(0))
        start = time.perf_counter()
        held = {"preexec_fn": lambda: os.sched_setaffinity(0, {core})} if count == 1 else {}
        run_command(words, folder / "log.txt", self.threads, **held)
        return time.perf_counter() - start

    def _difference(self, windows: int) -> float:
        """Largest difference between the tables that one process and several made of the same windows."""
        largest = [0.0]
        for window in range(windows):
            name = f"run/mmpi-small/1/windows/window-{window:05d}.pt"
            folders = [self._folder(count, self.steps) for count in (1, self.processes)]
            one, several = (torch.load(folder / name, weights_only=True)["field"] for folder in folders)
            kinds = [kind for kind, values in one.items() if values.is_floating_point() and values.numel()]
            largest += [float((one[kind] - several[kind]).abs().max()) for kind in kinds]
        return max(largest)

    def _markdown(self, rows: dict[int, dict[int, float]], h: Row, windows: int, made: Row) -> str:
        columns = {
            "processes": "{count}",
            f"{self.few} steps a window, s": lambda r: f"{rows[r['count']][self.few]:.1f}",
            f"{self.steps} steps, s": lambda r: f"{rows[r['count']][self.steps]:.1f}",
            "steps/s in between": "{rate:.1f}",
            "times": "{times:.2f}",
        }
        shown = [{"count": 1, "rate": h["one_steps_per_s"], "times": 1.0}]
        shown += [{"count": self.processes, "rate": h["several_steps_per_s"], "times": h["throughput_ratio"]}]
        said = f"{self.data.resolve().name} /{self.downscale_factor}, {windows} windows, {self.threads} thread(s) for "
        said += "each process; one process alone is held to one core."
        last = f"The windows' tables differ by at most {h['largest_difference']:g}."
        return page("Several processes", made, said, table(columns, shown), last)


def headline(rows: dict[int, dict[int, float]], processes: int, windows: int, few: int, steps: int) -> Row:
    """Steps per second beyond the first few, in one process and in several, and their ratio.

    Args:
        rows: by number of processes and steps a window: seconds.
        processes: the larger number.
        windows: that all train.
        few: steps a window of the shorter runs.
        steps: of the longer ones.
    """
    one, several = (windows * (steps - few) / (rows[n][steps] - rows[n][few]) for n in (1, processes))
    return {"one_steps_per_s": one, "several_steps_per_s": several, "throughput_ratio": several / one}


if __name__ == "__main__":
    sys.exit(run("processes", Processes))
