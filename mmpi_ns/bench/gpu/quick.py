"""``mmpi-bench gpu --quick``: in a minute, whether training runs on this machine's GPU as it should."""

from __future__ import annotations

import contextlib
import io
import platform
import warnings
from importlib import metadata
from pathlib import Path

import torch

from mmpi_ns.bench.gpu.parts import drive
from mmpi_ns.bench.report import Row, processor
from mmpi_ns.bench.trainers import Scene, Steps, no_tracks, train_words
from mmpi_ns.ops import dispatch

STEPS = 20
"""Steps that are timed."""


def environment() -> Row:
    """What the kernels run on and with."""
    found: Row = {"Python": platform.python_version(), "torch": torch.__version__, "CUDA of torch": torch.version.cuda}
    for package in ("triton", "nerfstudio", "gsplat", "nerfacc", "tinycudann"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    found["processor"] = processor()
    if torch.cuda.is_available():
        device = torch.cuda.get_device_properties(0)
        found["GPU"] = f"{device.name}, sm_{device.major}{device.minor}, {device.total_memory / 2**30:.0f} GiB"
    return found


def try_operations(device: str) -> dict[str, str | None]:
    """Every operation with a compiled form for a device: None where it works, else why not."""
    form = "gpu" if device == "cuda" else "cpu"
    names = [name for name, (_, forms) in dispatch.TABLE.items() if form in forms]
    with contextlib.redirect_stdout(io.StringIO()):  # the log of dispatch: it is said here
        return {name: dispatch.fault(name if device == "cuda" else "C++") for name in names}


def time_training(device: str, data: Path, work: Path, rays: int) -> Row:
    """Milliseconds of a step and of a frame of a small street."""
    options = (*drive(64, rays), "--pipeline.datamanager.dense-depth", "False", *no_tracks())
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of others' deprecations
        steps = Steps(train_words("mmpi-small", options, Scene(data, 1), work, 10 * STEPS, 0, device))
        steps.run(2)  # compiles
        seconds = steps.run(STEPS) / STEPS
        frame, pixels = min(steps.render(larger=2) for _ in range(3))
    return {"step_ms": 1e3 * seconds, "rays": rays, "frame_ms": 1e3 * frame, "pixels": pixels}


def run_quick(data: Path, work: Path, rays: int) -> Row:
    """Looks, tries, times, and says so line by line: environment, operations (why each falls back, or None), times of
    a small scene, and ``well``, the verdict."""
    found: Row = {"environment": environment()}
    for name, value in found["environment"].items():
        print(f"{name}: {value}", flush=True)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu":
        print(
            "torch sees no GPU, so nothing is said of one here: what follows is this machine's processor.", flush=True
        )
    found["device"], found["operations"] = device, try_operations(device)
    slow = {name: reason for name, reason in found["operations"].items() if reason is not None}
    for name in found["operations"]:
        print(f"{name}: {'plain torch, since ' + slow[name] if name in slow else 'ok'}", flush=True)
    found["timed"] = timed = time_training(device, data, work, rays)
    print(f"a step of {rays} rays: {timed['step_ms']:.1f} ms", flush=True)
    print(f"a frame of {timed['pixels']} pixels: {timed['frame_ms']:.1f} ms", flush=True)
    found["well"] = device == "cuda" and not slow
    print(_verdict(device, slow), flush=True)
    return found


def _verdict(device: str, slow: dict[str, str]) -> str:
    if slow:
        return (
            f"Training works, but {len(slow)} operation(s) run in plain torch, several times slower: {', '.join(slow)}."
        )
    if device == "cuda":
        return "All is well: every kernel runs on this GPU and agrees with plain torch."
    return "Training works on this processor. Whether it would on a GPU, only a machine with one can say."
