"""What ``benchmarks/gpu.py`` times, each part in a process of its own.

A part that fails, or breaks the device's context, takes no other with it. Parts look at the clock between measurements
and return what they have when their time is up: the named numbers that they add to the headline, and tables, by what is
said over each.
"""

from __future__ import annotations

import copy
import gc
import os
import statistics
import time
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from apart import Tell
from gpu_quick import drive
from kernel_checks import run_checks
from lab import median_s
from methods import TWO_PHASE
from report import Row, slug
from torch import Tensor
from trainers import BARE, P, Scene, Steps, train_words

from mmpi_ns.model import MMPIModel
from mmpi_ns.ops import dispatch
from mmpi_ns.rendering.metrics import ImageMetrics

FULL_WIDTH = 1242
"""Pixels across a frame of KITTI (375 down)."""


def interpret(on: bool) -> None:
    """Makes Triton's interpreter run the GPU kernels on CPU tensors. Raises ValueError if TRITON_INTERPRET=1 was not in
    the environment when the process started, or there is no Triton."""
    if on and os.environ.get("TRITON_INTERPRET") != "1":
        raise ValueError("Triton's interpreter must be asked for before Python starts: set TRITON_INTERPRET=1.")
    if on and (reason := dispatch.fault("Triton")) is not None:
        raise ValueError(f"Triton is not available: {reason}.")
    dispatch.interpreting = on


def check(request: Row, tell: Tell) -> Row:
    """Correctness first."""
    results = run_checks(request["device"], request["rehearse"])
    rows, failed = results["checks"], results["failed"]
    for row in rows:
        if not row["ok"]:
            tell(f"FAIL {row}")
    rendered = {r["name"]: {"error": r["error"], "bound": r["bound"], "": "ok" if r["ok"] else "FAIL"} for r in rows}
    intro = f"{len(rows)} comparisons with float64, {failed} failed."
    return {"headline": {"checks": len(rows), "failed_checks": failed}, "tables": {intro: rendered}, **results}


# Training ------------------------------------------------------------------------------------------------------------


def steps_of(request: Row, name: str, method: str, options: tuple[str, ...], steps: int) -> Steps:
    """A trainer on the benchmark's scene, on a device that holds nothing of an earlier one."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    scene = Scene(Path(request["data"]), request["downscale_factor"])
    folder = Path(request["work"]) / slug(name, "-")
    return Steps(train_words(method, (*BARE, *options), scene, folder, steps, 0, request["device"]))


def measure_training(request: Row, tell: Tell) -> Row:
    """Training rays/s, frames, memory and launches of a joint training of four MPIs, by one of the two paths."""
    small, path, device = request["rehearse"], request["ops"], request["device"]
    total, sizes, repeats = (4, (16,), 1) if small else (2000, (4096, 16_384), 10)
    options = ["--pipeline.model.ops", "torch" if path == "torch" else "auto"]
    options += ["--pipeline.model.eval-num-rays-per-chunk", "2048" if small else str(1 << 17)]
    options += ["--pipeline.datamanager.keypoint-rays", "4"] if small else []
    rows, limits = {}, {}
    for rays in sizes:
        ends = time.monotonic() + request["seconds"] / len(sizes)
        steps = steps_of(request, f"{path} {rays}", "mmpi", drive(8 if small else 256, rays, *options), total)
        row = rows[f"{rays} rays"] = train_for(steps, total, ends)
        row["rays_per_s"] = rays * row["late_steps_per_s"]
        if rays == sizes[0]:
            row |= count_launches(steps) if torch.cuda.is_available() else {}
            row |= render_both(steps, path, repeats)
            limits["copy_gb_per_s"] = copy_rate(device, 1 << (12 if small else 26)) / 1e9
        tell(f"{rays} rays: {row}")
        del steps
    first = rows[f"{sizes[0]} rays"]
    names = ("peak_gib", "frame_ms", "full_frame_ms", "psnr_delta_db", "launches_a_step", "waits_a_step")
    head = {"rays_per_s": max(r["rays_per_s"] for r in rows.values()), **{n: first[n] for n in names if n in first}}
    prefix, head = ("torch_", head) if path == "torch" else ("", head | limits)
    tables = {"`mmpi`, four MPIs by hand, 256 planes, trained together.": rows}
    return {"headline": {prefix + name: value for name, value in head.items()}, "tables": tables}


def copy_rate(device: str, size: int) -> float:
    """Bytes a second of a copy of so many numbers, read and written."""
    a = torch.ones(size, device=device)
    b = torch.empty_like(a)
    return 8 * size / median_s(lambda: b.copy_(a), 5)


def time_stages(steps: Steps, stages: list[Any], ends: float, blocks: int) -> dict[Any, list[float]]:
    """Trains until the run or the time is over: seconds of a step in each block, by the stage that it belongs to."""
    times: dict[Any, list[float]] = {}
    while steps.step < len(stages) and time.monotonic() < ends:
        stage, ahead = next(groupby(stages[steps.step :][: max(1, len(stages) // blocks)]))
        count = len(list(ahead))
        times.setdefault(stage, []).append(steps.run(count) / count)
    return times


def train_for(steps: Steps, total: int, ends: float) -> Row:
    """Steps a second while resolution grows and after it."""
    model = steps.pipeline.model
    assert isinstance(model, MMPIModel)
    steps.run(2)  # compiles
    times = time_stages(steps, [model.progress.schedule.sharpened(s) for s in range(total)], ends, 40)
    rates = {late: 1 / statistics.median(seconds) for late, seconds in times.items()}
    early, late = rates.get(False), rates.get(True, rates.get(False, 0.0))
    results = {"steps": steps.step, "early_steps_per_s": early, "late_steps_per_s": late}
    return results | {"texels": model.field.full_plan.texels, **memory()}


def memory() -> dict[str, float]:
    """Most memory that tensors held on the GPU at once."""
    return {"peak_gib": torch.cuda.max_memory_allocated() / 2**30} if torch.cuda.is_available() else {}


def count_launches(steps: Steps) -> dict[str, int]:
    """Kernels, and waits for the device, of one step."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        steps.run(1)
    calls = {e.key: e.count for e in profiler.key_averages()}
    launches = sum(n for name, n in calls.items() if name.startswith(("cudaLaunchKernel", "cuLaunchKernel")))
    return {"launches_a_step": launches, "waits_a_step": calls.get("cudaStreamSynchronize", 0)}


@torch.no_grad()
def render_both(steps: Steps, path: str, repeats: int) -> Row:
    """Milliseconds of a frame by the path that was trained; for Triton, its error against plain torch too."""
    pipeline, psnr = steps.pipeline, ImageMetrics("none")
    pipeline.eval()
    camera, batch = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    truth = batch["image"][..., :3].to(pipeline.device)
    truth = truth.float() / 255 if truth.dtype == torch.uint8 else truth

    def render(view: Any = camera) -> Tensor:
        return pipeline.model.get_outputs_for_camera(view)["rgb"]

    frame_s, rgb = median_s(render, repeats), render()
    larger = copy.deepcopy(camera)
    larger.rescale_output_resolution(FULL_WIDTH / rgb.shape[1] if repeats > 1 else 0.5)
    results = {
        "frame_ms": 1e3 * frame_s,
        "frame_pixels": rgb.shape[0] * rgb.shape[1],
        "psnr": psnr(rgb, truth)["psnr"],
        "full_frame_ms": 1e3 * median_s(lambda: render(larger), repeats),
        "full_frame_pixels": int(larger.width) * int(larger.height),
    }
    if path != "torch":
        dispatch.choose("torch")
        plain = render()
        dispatch.choose("auto")
        results["largest_difference"] = float((rgb - plain).abs().max())
        results["psnr_delta_db"] = results["psnr"] - psnr(plain, truth)["psnr"]
    pipeline.train()
    return results


def measure_kitti(request: Row, tell: Tell) -> Row:
    """``mmpi-kitti`` at the paper's size, its schedule run through in fewer steps; what 40,000 would take.

    Both readings of the paper's 30,000 individual steps: the MPIs share each batch, or each renders all of it.
    """
    small, head, tables, facts = request["rehearse"], {}, {}, {}
    total = 3 if small else 1000
    for reading in ("split", "all"):
        ends = time.monotonic() + request["seconds"] / 2
        options = ("--pipeline.model.schedule.rays-per-mpi", reading)
        if small:
            options += (P + "planes", "6", P + "height", "12", P + "width", "12", *TWO_PHASE)
            options += ("--pipeline.datamanager.train-num-rays-per-batch", "16")
        steps = steps_of(request, f"kitti {reading}", "mmpi-kitti", options, total)
        row, stages = time_phases(steps, total, ends)
        facts[f"`rays-per-mpi {reading}`"], tables[f"Stages of `rays-per-mpi {reading}`:"] = row, stages
        head |= {f"kitti_{reading}_{n}": row[n] for n in ("steps_per_s", "minutes_of_40000_steps")}
        head |= {f"kitti_{reading}_{n}": value for n, value in memory().items()}
        tell(f"{reading}: {row}")
        del steps
    intro = "The paper's KITTI size, its schedule in fewer steps, and what 40,000 would take."
    return {"headline": head, "tables": {intro: facts, **tables}}


def time_phases(steps: Steps, total: int, ends: float) -> tuple[Row, Row]:
    """The minutes of 40,000 steps, and milliseconds of a step at each resolution and phase.

    A step whose stage was not reached within the time is given the mean of the last stage that was.
    """
    model = steps.pipeline.model
    schedule = model.progress.schedule
    stages = [(schedule.phase_at(s).name, schedule.texel_factor(s)) for s in range(total)]
    steps.run(1)
    times, means, last = time_stages(steps, stages, ends, 100), {}, 0.0
    for stage in dict.fromkeys(stages):
        # The median: the first steps of a stage compile kernels and resample tables.
        means[stage] = last = statistics.median(times[stage]) if stage in times else last
    mean_s = sum(means[s] for s in stages) / total
    row = {
        "steps_run": steps.step,
        "reached_the_end": steps.step >= total,
        "steps_per_s": 1 / mean_s if mean_s else 0.0,
        "minutes_of_40000_steps": mean_s * 40_000 / 60,
        "parameters": sum(p.numel() for p in model.parameters()),
        **memory(),
    }
    return row, {f"{name}, {factor:.3g} of the texels": {"ms a step": 1e3 * s} for (name, factor), s in means.items()}


PARTS: dict[str, Callable[[Row, Tell], Row]] = {
    "checks": check,
    "training": measure_training,
    "kitti": measure_kitti,
}


def run_part(request: Row, tell: Tell) -> Row:
    """One part, as asked."""
    if request["rehearse"]:
        torch.set_num_threads(1)
        interpret(True)
    name = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU (rehearsal by Triton's interpreter)"
    return {**PARTS[request["part"]](request, tell), "device": name}
