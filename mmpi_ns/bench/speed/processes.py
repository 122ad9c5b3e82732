"""``mmpi-bench processes``: what several processes on one machine make of a long capture's windows."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mmpi_ns.bench.provenance import fingerprint, read_json, stamp, stamp_line, write_json


@dataclass
class Processes:
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
    output: Path = Path("docs/results")
    """Where processes.json and processes.md go."""
    work: Path = Path("outputs/processes")
    """Where runs and their logs go."""

    def run(self) -> None:
        made, path = stamp("processes", self), self.output / "processes.json"
        key = f"{fingerprint()} {self.data.resolve().name} /{self.downscale_factor} {self.few} to {self.steps} steps"
        before = read_json(path)
        rows = before.get("rows", {}) if before.get("key") == key else {}
        content: dict[str, Any] = {"headline": {}, "made": made | {"threads": 1}, "key": key, "rows": rows}
        content["windows"] = self._plan()
        for count in (1, self.processes):
            row = rows.setdefault(str(count), {})
            for steps in (self.few, self.steps):
                if str(steps) not in row:
                    row[str(steps)] = self._train(count, steps)
                    write_json(path, content)
                print(f"{count} processes, {steps} steps a window: {row[str(steps)]:.1f} s", flush=True)
        content["headline"] = {
            **headline(rows, self.processes, content["windows"], self.few, self.steps),
            "largest_difference": self._difference(content["windows"]),
        }
        write_json(path, content)
        (self.output / "processes.md").write_text(self._table(content), encoding="utf-8")
        print(content["headline"])

    def _plan(self) -> int:
        """Places MPIs for the steps of the longer run; returns how many windows there are."""
        from mmpi_ns.capture.load import load_observations
        from mmpi_ns.config import mmpi_small
        from mmpi_ns.placement.split import place_windows

        manager: Any = mmpi_small.config.pipeline.datamanager
        observations = load_observations(self.data, downscale_factor=self.downscale_factor)
        settings: Any = mmpi_small.config.pipeline.model
        plan = place_windows(observations, settings.placement, self.steps * manager.train_num_rays_per_batch)
        if len(plan) < self.processes:
            raise ValueError(
                f"{self.data} has {len(plan)} window(s), too few for {self.processes} processes: give a longer capture."
            )
        self.work.mkdir(parents=True, exist_ok=True)
        (self.work / "plan.json").write_text(plan.to_json(), encoding="utf-8")
        return len(plan)

    def _folder(self, count: int, steps: int) -> Path:
        return self.work / f"{count} of {steps}"

    def _train(self, count: int, steps: int) -> float:
        """Trains all windows; returns seconds by the clock."""
        folder = self._folder(count, steps)
        shutil.rmtree(folder, ignore_errors=True)  # windows that are finished there would not be trained again
        folder.mkdir(parents=True)
        words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
        words += ["-m", "mmpi_ns.scripts.train", "mmpi-small", "--max-num-iterations", str(steps)]
        words += ["--steps-per-save", str(100 * steps), "--vis", "tensorboard", "--machine.device-type", "cpu"]
        words += ["--pipeline.model.plan-file", str(self.work / "plan.json"), "--output-dir", str(folder)]
        words += ["--experiment-name", "road", "--timestamp", "run", "--data", str(self.data)]
        words += ["nerfstudio-data", "--downscale-factor", str(self.downscale_factor)]
        core = min(os.sched_getaffinity(0))
        start = time.perf_counter()
        with (folder / "log.txt").open("w", encoding="utf-8") as log:
            status = subprocess.run(
                words,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                preexec_fn=(lambda: os.sched_setaffinity(0, {core})) if count == 1 else None,
            ).returncode
        if status:
            raise ValueError(f"Training with {count} processes failed with status {status}; see {folder / 'log.txt'}.")
        return time.perf_counter() - start

    def _difference(self, windows: int) -> float:
        """Largest difference between the tables that one process and several made of the same windows."""
        largest = 0.0
        for window in range(windows):
            name = f"road/mmpi-small/run/windows/window-{window:05d}.pt"
            one, several = (
                torch.load(self._folder(c, self.steps) / name, weights_only=True)["field"] for c in (1, self.processes)
            )
            for kind, values in one.items():
                if values.is_floating_point():
                    largest = max(largest, float((values - several[kind]).abs().max()) if values.numel() else 0.0)
        return largest

    def _table(self, content: dict[str, Any]) -> str:
        """The Markdown page."""
        h = content["headline"]
        lines = [
            "# Several processes",
            "",
            stamp_line(content["made"]),
            "",
            f"{self.data.resolve().name} /{self.downscale_factor}, {content['windows']} windows, one thread for each "
            "process; one process alone is held to one core.",
            "",
            f"| processes | {self.few} steps a window, s | {self.steps} steps, s | steps/s in between | times |",
            "|---|---|---|---|---|",
        ]
        for count, rate, times in (
            (1, h["one_steps_per_s"], 1.0),
            (self.processes, h["several_steps_per_s"], h["throughput_ratio"]),
        ):
            row = content["rows"][str(count)]
            few, all_ = row[str(self.few)], row[str(self.steps)]
            lines.append(f"| {count} | {few:.1f} | {all_:.1f} | {rate:.1f} | {times:.2f} |")
        lines += ["", f"The windows' tables differ by at most {h['largest_difference']:g}.", ""]
        return "\n".join(lines)


def headline(rows: dict[str, dict[str, float]], processes: int, windows: int, few: int, steps: int) -> dict[str, float]:
    """Steps per second beyond the first few, in one process and in several, and their ratio.

    Args:
        rows: by number of processes and steps a window (as text): seconds.
        processes: the larger number.
        windows: that all train.
        few: steps a window of the shorter runs.
        steps: of the longer ones.
    """

    def rate(count: int) -> float:
        row = rows[str(count)]
        return windows * (steps - few) / (row[str(steps)] - row[str(few)])

    one, several = rate(1), rate(processes)
    return {"one_steps_per_s": one, "several_steps_per_s": several, "throughput_ratio": several / one}
