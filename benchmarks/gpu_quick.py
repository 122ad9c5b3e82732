"""Check of training on this machine's GPU, in a minute or two: ``python benchmarks/gpu_quick.py``."""

from __future__ import annotations

import contextlib
import io
import json
import platform
import sys
import warnings
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import Any

import numpy as np
import torch
from PIL import Image
from trainers import JOINT, NO_TRACKS, P, Scene, Steps, train_words

from mmpi_ns.ops import dispatch
from mmpi_ns.scripts.command import run
from mmpi_ns.utils.machine import processor

DRIVER = Path("/proc/driver/nvidia/version")
STEPS, RAYS = 20, 1024
"""Number of timed steps, and rays of each."""


@dataclass
class GpuQuick:
    """Compares the kernels with plain torch on this machine, and times a step and a frame; without a GPU, those of the
    processor.

    Comparisons with float64 and times of whole trainings: benchmarks/gpu.py and benchmarks/train.py.
    """

    folder: Path = Path("outputs/gpu")
    """Folder for a small capture, its training, and gpu.json with all results."""

    def main(self) -> None:
        write = partial(print, flush=True)
        report: dict[str, Any] = {"environment": environment()}
        for name, value in report["environment"].items():
            write(f"{name}: {value}")
        report["device"] = device = "cuda" if torch.cuda.is_available() else "cpu"
        if device == "cpu":
            write("torch sees no GPU: the following is measured on this machine's CPU.")
        reason = dispatch.fault("Triton" if device == "cuda" else "C++")
        report["timed"] = timed = time_training(device, noise(self.folder / "noise"), (self.folder / "run").resolve())
        step, frame, pixels = timed["step_ms"], timed["frame_ms"], timed["pixels"]
        write(f"a step of {RAYS} rays: {step:.1f} ms, {1e3 * RAYS / step:,.0f} rays/s")
        write(f"a frame of {pixels} pixels: {frame:.1f} ms, {1e3 / frame:.1f} frames/s")
        write(f"memory: {timed['peak_gib']:.2f} GiB")
        report["well"] = not (reason or timed["differs"])
        if reason:
            write(f"Training works in plain torch, several times slower: {reason}.")
        elif timed["differs"]:
            write(f"Compiled operations and plain torch differ here: {timed['differs']}. Report it with this output.")
        else:
            write(f"All is well: the compiled operations run on this {device} and agree with plain torch.")
        (self.folder / "gpu.json").write_text(json.dumps(report, indent=1), encoding="utf-8")


def noise(folder: Path) -> Path:
    """Folder of a drive past random colours, written if it is missing: enough to time a step."""
    if not (folder / "transforms.json").is_file():
        (folder / "images").mkdir(parents=True, exist_ok=True)
        rng, frames, (width, height) = np.random.default_rng(0), [], (155, 47)
        for i in range(10):
            image = Image.fromarray(rng.integers(0, 256, (6, 20, 3), dtype=np.uint8)).resize((width, height))
            image.save(folder / f"images/{i}.png")
            pose = np.vstack([np.eye(3, 4), [0, 0, 0, 1]])
            pose[2, 3] = -float(i)
            frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()})
        focal = {"fl_x": 0.58 * width, "fl_y": 0.58 * width}
        camera = focal | {"cx": width / 2, "cy": height / 2, "w": width, "h": height}
        (folder / "transforms.json").write_text(json.dumps(camera | {"frames": frames}), encoding="utf-8")
    return folder.resolve()


def drive(planes: int, rays: int, *more: str) -> tuple[str, ...]:
    """Four MPIs by hand, trained together."""
    place = (P + "arrangement", "drive", P + "planes", str(planes), P + "max-planes", str(planes))
    return (*place, *JOINT, "--pipeline.datamanager.train-num-rays-per-batch", str(rays), *more)


def environment() -> dict[str, Any]:
    """Versions and device of the environment."""
    report: dict[str, Any] = {"Python": platform.python_version(), "torch": torch.__version__}
    report["CUDA of torch"] = torch.version.cuda
    for package in ("triton", "nerfstudio", "gsplat", "nerfacc", "tinycudann"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            report[package] = metadata.version(package)
    report["processor"] = processor()
    with contextlib.suppress(OSError):
        report["driver"] = DRIVER.read_text(encoding="utf-8").splitlines()[0].removeprefix("NVRM version:").strip()
    if torch.cuda.is_available():
        device = torch.cuda.get_device_properties(0)
        report["GPU"] = f"{device.name}, sm_{device.major}{device.minor}, {device.total_memory / 2**30:.0f} GiB"
    return report


def time_training(device: str, data: Path, work: Path) -> dict[str, Any]:
    """Milliseconds of a step and of a frame of a small capture, and differences between compiled operations and plain
    torch."""
    manager = [f"--pipeline.datamanager.priors.{name}" for name in ("dense-depth", "mask-moving", "correct-exposure")]
    options = (*drive(64, RAYS), *(word for name in manager for word in (name, "False")), *NO_TRACKS)
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of others' deprecations
        steps = Steps(train_words("mmpi", options, Scene(data, 1), work, 10 * STEPS, 0, device))
        steps.run(2)  # compiles
        differs = steps.trainer.kernels_differ()
        seconds = steps.run(STEPS) / STEPS
        frame, pixels = min(steps.render(larger=2) for _ in range(3))
    timed = {"step_ms": 1e3 * seconds, "rays": RAYS, "frame_ms": 1e3 * frame, "pixels": pixels, "differs": differs}
    peak = torch.cuda.max_memory_allocated() if device == "cuda" else 1024 * getrusage(RUSAGE_SELF).ru_maxrss
    return timed | {"peak_gib": peak / 2**30}


if __name__ == "__main__":
    sys.exit(run("gpu_quick", GpuQuick))
