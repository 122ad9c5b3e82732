"""Ordinary captures through the commands: trained for a few steps, evaluated, and exported as a web page.

    python benchmarks/matrix.py --folder /tmp/matrix                 # all rows, hours; goes on where it was interrupted
    python benchmarks/matrix.py --folder /tmp/matrix --most 10       # captures of up to 10 megapixels, minutes

Each command must end well, or in one sentence. Writes docs/results/matrix.md from the rows that have been run.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import tyro
from apart import environment_of
from ordinary_captures import MATRIX, STEP, Capture, write_capture
from report import commit

STEPS = 10
MOST_MATCHED = 40
"""Megapixels of a capture up to which images are matched densely: it would take hours for the largest."""
DISTANCE = 6.0
"""About the median distance of the street's points."""


@dataclass
class Matrix:
    """Options of the command."""

    folder: Path
    """Where captures and runs are written, and removed again."""
    most: float = float("inf")
    """Captures of more megapixels are left out."""
    output: Path = Path("docs/results/matrix.md")
    """The table."""

    def main(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        done = self.folder / "rows.json"
        rows: dict[str, Any] = json.loads(done.read_text()) if done.is_file() else {}
        for capture in sorted(MATRIX, key=lambda capture: capture.megapixels):
            if capture.name not in rows and capture.megapixels <= self.most:
                rows[capture.name] = run_capture(capture, self.folder.resolve() / "capture") | {"commit": commit()}
                print(capture.name, json.dumps(rows[capture.name]), flush=True)
                done.write_text(json.dumps(rows))
        self.output.write_text(report(rows), encoding="utf-8")


def options(capture: Capture) -> dict[str, Any]:
    """Options of ns-train that make a capture's run short and give it one window or several, by their dotted names."""
    length = max(STEP * (capture.images - 1) / DISTANCE / 2.5, 0.01) if capture.windows == "several" else 0.0
    return {
        "pipeline.model.placement.window_length": length,
        "pipeline.datamanager.priors.dense_depth": capture.megapixels <= MOST_MATCHED,
        "pipeline.datamanager.dataparser.load_3D_points": capture.depth == "points",
    }


def commands(capture: Capture, data: Path, output: Path) -> dict[str, list[str]]:
    """What a user would type, by what it is for."""
    train = ["ns-train", "mmpi-small", "--data", str(data), "--output-dir", str(output), "--experiment-name", "matrix"]
    train += ["--timestamp", "run", "--max-num-iterations", str(STEPS), "--vis", "tensorboard"]
    train += ["--machine.device-type", "cpu", "--pipeline.model.lpips-net", "none"]
    parser = ["nerfstudio-data"]  # its options follow its name
    for name, value in options(capture).items():
        *_, group, last = name.split(".")
        prefix = "--" if group == "dataparser" else f"--{name.removesuffix(last).replace('_', '-')}"
        (parser if group == "dataparser" else train).extend([prefix + last.replace("_", "-"), str(value)])
    config = ["--load-config", str(output / "matrix/mmpi-small/run/config.yml")]
    return {
        "train": train + parser,
        "eval": ["ns-eval", *config, "--output-path", str(output / "eval.json")],
        "web": ["mmpi-export", "web", *config, "--output", str(output / "site"), "--compare", "1"],
    }


def run_capture(capture: Capture, folder: Path) -> dict[str, Any]:
    """Outcome, processor seconds and peak memory (GiB) of each command, and the score."""
    shutil.rmtree(folder, ignore_errors=True)
    data, output = write_capture(capture, folder / "data"), folder / "output"
    rows: dict[str, Any] = {}
    for name, command in commands(capture, data, output).items():
        rows[name] = run_command(command, folder)
        if rows[name]["outcome"] != "well":
            break
    scores = output / "eval.json"
    rows["psnr"] = json.loads(scores.read_text())["results"]["psnr"] if scores.is_file() else None
    shutil.rmtree(folder)
    return rows


def run_command(command: list[str], folder: Path) -> dict[str, Any]:
    """How a command ends: "well", its sentence, or "TRACEBACK" with the last line."""
    environment = environment_of(1) | {"XDG_CACHE_HOME": str(folder / "cache"), "COLUMNS": "1000"}
    program = Path(sys.executable).with_name(command[0])
    with open(folder / "errors", "w+") as errors:
        process = subprocess.Popen(
            [str(program), *command[1:]], stdout=subprocess.DEVNULL, stderr=errors, cwd=folder, env=environment
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        errors.seek(0)
        intro = [line for line in errors.read().splitlines() if line.strip()]
    outcome = "well"
    if process.returncode:
        is_sentence = (
            not any("Traceback" in line for line in intro) and intro and intro[-1].startswith(f"{command[0]}: ")
        )
        outcome = intro[-1] if is_sentence else f"TRACEBACK: {intro[-1] if intro else process.returncode}"
    return {"outcome": outcome, "seconds": usage.ru_utime + usage.ru_stime, "gib": usage.ru_maxrss / 2**20}


def report(rows: dict[str, Any]) -> str:
    """The page."""
    processor = next(
        (x.split(":")[1].strip() for x in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in x), "?"
    )
    lines = [
        "# Ordinary captures",
        "",
        f"`python benchmarks/matrix.py --folder FOLDER`, one thread of an {processor}. The last column is the commit.",
        "",
        f"Each capture was trained for {STEPS} steps a window (`ns-train mmpi-small`), evaluated (`ns-eval`) and "
        "exported (`mmpi-export web`). The rows hold every number of images with every size, and every other pair of "
        "properties at least once. What matters is that each command ends well or in one sentence; PSNR after so few "
        "steps says nothing about quality. Images are a procedural street; two of more than 30 are test images. "
        f"Captures of more than {MOST_MATCHED} megapixels were trained without dense matching. Seconds are of the "
        "processor, memory is the peak of each command.",
        "",
        "| images | pixels | shape | lens | depth | windows | train | | eval | | web | | PSNR | commit |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    peaks = []
    for capture in MATRIX:
        if (row := rows.get(capture.name)) is None:
            continue
        cells = [str(value) for value in vars(capture).values()]
        for name in ("train", "eval", "web"):
            part = row.get(name)
            ends = "" if part is None else "" if part["outcome"] == "well" else part["outcome"] + ", "
            cells += ["", ""] if part is None else [f"{ends}{part['seconds']:.0f} s", f"{part['gib']:.1f} GiB"]
        peaks.append(row["train"]["gib"])
        cells += ["" if row["psnr"] is None else f"{row['psnr']:.1f}", row["commit"]]
        lines.append(f"| {' | '.join(cells)} |")
    missing = [capture.name for capture in MATRIX if capture.name not in rows]
    lines += ["", f"Training peaks at {max(peaks):.1f} GiB at most, {median(peaks):.1f} in the median."]
    lines += [f"Not run: {', '.join(missing)}."] if missing else []
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    tyro.cli(Matrix).main()
