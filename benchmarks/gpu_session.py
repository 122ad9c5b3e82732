"""All that a machine with a GPU can tell of this project, in one call of ten minutes, without a network.

    python benchmarks/gpu_session.py --data CAPTURE --out FOLDER [--wheels FOLDER] [--seconds 590]
    python benchmarks/gpu_session.py --rehearse --out FOLDER [--only environment quick "train mmpi" ...]

What it found is written to FOLDER/session.json after every part, so that a call that is cut off loses only the part at
hand. Wheels (of what the machine lacks) are installed into a folder of their own; without pycolmap among them the
capture's tracks are not read. ``--rehearse`` runs the same commands on a CPU in miniature, on a procedural street and
without the packages that a bare machine lacks, to see that each starts and ends.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STEPS = {"mmpi-small": (1000, (60, 500), 70), "mmpi-kitti": (800, (200, 640), 80), "mmpi": (1000, (60, 400), 80)}
"""Steps of a pressed run, those after which steps by operations and graphs alternate, and seconds at most."""
TRAININGS = {"mmpi": (20_000, 110), "splatfacto": (5000, 75), "nerfacto": (5000, 75), "mmpi-small": (4000, 50),
             "instant-ngp": (5000, 60)}  # fmt: skip
"""Steps, and seconds at most, of each method on the capture at full size."""
BENCH_PARTS = ("checks", "training triton")
"""Of ``benchmarks/gpu.py``; trainings to the end come after it."""
BARE = ("pycolmap", "open3d", "pymeshlab", "wandb", "comet_ml")
"""Packages that the machine is not expected to have."""
METHODS = ",".join(f"mmpi{n}=mmpi_ns.config:mmpi{n.replace('-', '_')}" for n in ("", "-small", "-kitti"))
"""For nerfstudio's registry: the package itself is not installed there."""
TAIL = 6000
"""Characters of what a part prints that are kept."""


@dataclass(frozen=True)
class Part:
    """A command, and the seconds that it may take."""

    name: str
    words: list[str]
    seconds: float


def parts(data: Path, out: Path, work: Path, rehearse: bool) -> list[Part]:
    """Everything, in the order of what is wanted most."""
    python, names = [sys.executable], ("gpu.py", "gpu_quick.py", "gpu_steps.py", "train.py")
    gpu, quick, steps, train = ([*python, str(ROOT / "benchmarks" / name)] for name in names)
    where = ["--output", str(out), "--work", str(work)]
    look = "import platform, torch; print(platform.python_version(), torch.__version__, torch.version.cuda, flush=True)"
    look += "; import triton; print('Triton', triton.__version__, flush=True)"
    look += "; import nerfstudio.configs.method_configs, mmpi_ns.config; print('nerfstudio and mmpi_ns import')"
    small = ["--data", str(data), *(["--rehearse", "--parts", "checks"] if rehearse else ["--parts", *BENCH_PARTS])]
    return [
        Part("device", ["nvidia-smi"], 20),
        Part("environment", [*python, "-c", look], 90),
        Part("quick", [*quick, "--folder", str(work / "quick")], 120),
        Part("tests", [*python, "-m", "pytest", "-m", "gpu", "-rs", "-p", "no:cacheprovider", "tests/ops"], 120),
        Part("costs", [*steps, "costs", "--out", str(out / "costs.json")], 40),
        *(
            Part(f"steps {name}", [*steps, name, *_steps(name, data, out, rehearse)], most)
            for name, (*_, most) in STEPS.items()
        ),
        Part("bench gpu", [*gpu, *small, *where, "--seconds", "1800" if rehearse else "120"], 150),
        *(
            Part(f"train {name}", [*train, *_training(name, steps, data, rehearse), *where], seconds)
            for name, (steps, seconds) in TRAININGS.items()
        ),
    ]


def strip(folder: Path) -> None:
    """From now on Python finds none of the packages that a bare machine lacks."""
    folder.mkdir()
    lines = ("import sys", f"sys.modules.update(dict.fromkeys({BARE!r}))")
    (folder / "sitecustomize.py").write_text("\n".join(lines), encoding="utf-8")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(folder), os.environ["PYTHONPATH"]])


def mib(path: Path | None) -> float:
    """What a folder takes that is carried along."""
    return 0.0 if path is None else sum(p.stat().st_size for p in path.rglob("*") if p.is_file()) / 2**20


def _training(name: str, steps: int, data: Path, rehearse: bool) -> list[str]:
    """Options of ``benchmarks/train.py``; splats have no rays."""
    words = ["--data", str(data), "--methods", name, "--downscale-factor", "1", "--seeds", "0", "--check-images", "1"]
    words += ["--steps", f"{name}={2 if rehearse else steps}", "--final-images", "1" if rehearse else "8"]
    if rehearse:
        return [*words, "--device", "cpu", "--rays-per-batch", f"{name}=16"]
    return [*words, "--device", "cuda", "--rays-per-batch", "nerfacto=4096"]


def _steps(name: str, data: Path, out: Path, rehearse: bool) -> list[str]:
    """Options of ``gpu_steps.py``."""
    count, stages, _ = (6, (2,), 0) if rehearse else STEPS[name]
    words = ["--data", str(data), "--steps", str(count), "--stages", *map(str, stages)]
    return [*words, "--out", str(out / f"steps-{name}.json")]


def run_part(part: Part, seconds: float, log: Path) -> dict[str, object]:
    """Runs a command, its output into a file; ended with all that it started when its time is up."""
    start, late = time.monotonic(), threading.Event()
    with log.open("wb") as stream:
        try:
            process = subprocess.Popen(
                part.words, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT, cwd=ROOT,
                start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            return {"status": None, "wall_s": 0.0, "output": f"{type(error).__name__}: {error}"}

        def end() -> None:
            late.set()
            os.killpg(process.pid, 9)

        alarm = threading.Timer(seconds, end)
        alarm.start()
        status = process.wait()
        alarm.cancel()
    text = log.read_text(encoding="utf-8", errors="replace")[-TAIL:]
    status = status or int("not run: it failed" in text)  # benchmarks record what fails and go on
    return {"status": status, "ran_out_of_time": late.is_set(), "wall_s": time.monotonic() - start, "output": text}


def install(wheels: Path, site: Path) -> Part:
    """Of the wheels, into a folder that Python looks in from now on."""
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(site), os.environ.get("PYTHONPATH", "")])
    files = [str(path) for path in sorted(wheels.glob("*.whl"))]
    words = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps", "--target", str(site), *files]
    return Part("wheels", words, 90)


def main() -> int:
    """Runs all parts; 0 where each of them did its work, or said why it cannot here."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--data", type=Path, help="a capture (a folder with transforms.json)")
    options.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", "outputs/gpu-session")))
    options.add_argument("--wheels", type=Path, help="wheels of what this machine lacks")
    options.add_argument("--seconds", type=float, default=590.0, help="for everything")
    options.add_argument("--rehearse", action="store_true", help="in miniature, on a CPU")
    options.add_argument("--only", nargs="+", help="names of parts; all unless given")
    given = options.parse_args()
    if given.data is None and not given.rehearse:
        options.error("--data is needed: a capture to train on")
    out, start = given.out.resolve(), time.monotonic()
    (out / "logs").mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix="gpu-session-"))  # checkpoints are too large to bring back
    data = (given.data or work / "quick" / "noise").resolve()  # which the quick look makes
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    os.environ["NERFSTUDIO_METHOD_CONFIGS"] = METHODS
    if given.rehearse:
        strip(work / "bare")
    todo = [p for p in parts(data, out, work, given.rehearse) if given.only is None or p.name in given.only]
    if given.wheels is not None:
        todo.insert(int(todo[0].name == "device"), install(given.wheels.resolve(), work / "site"))
    carried = {"data": mib(given.data), "wheels": mib(given.wheels)}
    print({name: round(size, 1) for name, size in carried.items()}, "MiB carried", flush=True)
    results: dict[str, dict[str, object]] = {}
    for part in todo:
        left = given.seconds - (time.monotonic() - start)
        intro: dict[str, object] = {"status": None, "wall_s": 0.0, "output": "no time was left"}
        if left > 5:
            seconds = left if given.rehearse else min(part.seconds, left)
            intro = run_part(part, seconds, out / "logs" / f"{part.name}.txt")
        results[part.name] = {"command": part.words, **intro}
        for log in work.rglob("output.log"):
            shutil.copy(log, out / "logs" / f"{'-'.join(log.relative_to(work).parts[:-1])[-120:]}.log")
        report = {"command": sys.argv, "rehearsal": given.rehearse, "carried_mib": carried, "parts": results}
        report["wall_s"] = time.monotonic() - start
        (out / "session.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
        print(f"{part.name}: status {intro['status']}, {intro['wall_s']:.0f} s", flush=True)
    needed = [name for name in results if name != "device" or not given.rehearse]
    shutil.rmtree(work, ignore_errors=True)
    return int(any(results[name]["status"] != 0 for name in needed))


if __name__ == "__main__":
    sys.exit(main())
