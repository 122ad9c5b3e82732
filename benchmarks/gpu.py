"""On a GPU, in minutes and without a network: correctness first, then training and frames."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from apart import run_apart
from gpu_parts import run_part
from report import Bench, Report, Row, page, slug, table, title

from mmpi_ns.scripts.command import run
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset

SHARES = {"checks": 0.25, "training triton": 0.25, "training torch": 0.2, "kitti": 0.3}
"""The parts in the order in which they run, and their shares of the time; what one leaves, the next ones have."""
GRACE = 60.0
"""Seconds that a part may run beyond its time before it is ended from outside: starting Python takes ten."""


@dataclass
class Gpu(Bench):
    """Kernels against float64, then training, frames, and the paper's KITTI size, on one GPU.

    Every part runs in a process of its own within its share of the time: one that fails is recorded, and the others go
    on. Ends with status 1 where a kernel is wrong. For error over time there, see train.
    """

    data: Path | None = None
    """A drive (a folder with transforms.json); a procedural street is made where none is given."""
    downscale_factor: int = 1
    """Image size to use."""
    seconds: float = 400.0
    """For everything."""
    parts: tuple[str, ...] = tuple(SHARES)
    """Which parts to run."""
    rehearse: bool = False
    """Run everything in miniature on a CPU, the kernels by Triton's interpreter: to see that it runs, not how fast."""

    name = "gpu"

    def run(self) -> None:
        self._check()
        start, report = time.monotonic(), Report(self, key=None)
        made, rows = report.content["made"], report.rows
        data, report.content["rehearsal"] = self._scene(), self.rehearse
        made["scene_seconds"] = time.monotonic() - start
        for number, name in enumerate(self.parts):
            left = self.seconds - (time.monotonic() - start)
            share = SHARES[name] / sum(SHARES[n] for n in self.parts[number:])
            print(f"{name}: {max(0.0, left * share):.0f} s ...", flush=True)
            begin = time.monotonic()
            results = self._part(name, data, left * share) if left > 0 else {"not_run": "no time was left"}
            rows[name] = {**results, "wall_s": time.monotonic() - begin}
            head = {k: v for part in rows.values() for k, v in part.get("headline", {}).items()}
            report.finish(head, markdown(report.content, head))
        head = report.content["headline"]
        print(head)
        wrong = [name for name, part in rows.items() if "not_run" in part] if self.rehearse else []
        if head.get("failed_checks") or wrong:
            raise SystemExit(f"gpu: a kernel is wrong or a rehearsed part failed ({', '.join(wrong) or 'checks'}).")

    def _check(self) -> None:
        """Raises ValueError where nothing could be measured."""
        if unknown := set(self.parts) - set(SHARES):
            raise ValueError(f"There is no part {sorted(unknown)[0]!r}: choose from {', '.join(SHARES)}.")
        if not self.rehearse and not torch.cuda.is_available():
            raise ValueError(
                "gpu measures a CUDA device, and torch sees none: run it where there is one, or --rehearse on a CPU."
            )
        if self.data is not None and not self.data.exists():
            raise ValueError(f"There is no scene at {self.data}: check --data.")

    def _scene(self) -> Path:
        """The data set, or a street that is made now."""
        if self.data is not None:
            return self.data.resolve()
        count, width, height, points = (10, 40, 12, 150) if self.rehearse else (40, 621, 188, 4000)
        folder = self.folder / "street"
        if not (folder / "transforms.json").is_file():
            print(f"Making a street of {width} x {height} pixels ...", flush=True)
            scene = make_scene("street", count=count, width=width, height=height)
            write_dataset(scene, folder, points=points, overwrite=True)
        return folder.resolve()

    def _part(self, name: str, data: Path, seconds: float) -> Row:
        part, _, ops = name.partition(" ")
        device = "cpu" if self.rehearse else "cuda"
        request = {"part": part, "ops": ops, "device": device, "rehearse": self.rehearse}
        request |= {"data": str(data), "downscale_factor": self.downscale_factor, "work": str(self.folder.resolve())}
        request["seconds"] = max(5.0, seconds - 15)  # less what it takes to start
        hidden = {"TRITON_INTERPRET": "1", "CUDA_VISIBLE_DEVICES": ""} if self.rehearse else {}
        threads = 1 if self.rehearse else self.cores
        return run_apart(run_part, request, self.folder / slug(name, "-"), threads, seconds + GRACE, hidden)


def markdown(content: Row, head: Row) -> str:
    """The page: every table of every part."""
    parts = content["rows"]
    device = next((part["device"] for part in parts.values() if "device" in part), "no part has run")
    blocks = [f"On: {device}."]
    if content["rehearsal"]:
        blocks.append("**A rehearsal in miniature on a CPU: no number here is a measurement.**")
    for name, part in parts.items():
        blocks += [f"## {title(name)} ({part['wall_s']:.0f} s)"]
        blocks += [f"Not run: {part['not_run']}"] if "not_run" in part else []
        for intro, rows in part.get("tables", {}).items():
            names = dict.fromkeys(k for row in rows.values() for k in row)
            columns = {"of": "{row}"}
            columns |= {n.replace("_", " "): lambda r, n=n: _number(r.get(n)) for n in names}
            blocks += [intro, table(columns, ({"row": name, **row} for name, row in rows.items()))]
    numbers = ({"name": name, "value": _number(value)} for name, value in head.items())
    return page("On a GPU", content["made"], blocks, "## Headline", table({"": "{name}", "value": "{value}"}, numbers))


def _number(value: Any) -> str:
    if not isinstance(value, int | float):
        return "-" if value is None else str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


if __name__ == "__main__":
    sys.exit(run("gpu", Gpu))
