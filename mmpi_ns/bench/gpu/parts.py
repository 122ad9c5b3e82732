"""What ``mmpi-bench gpu`` times, each part in a process of its own.

A part that fails, or breaks the device's context, takes no other with it. Parts look at the clock between measurements
and return what they have when their time is up.
"""

from __future__ import annotations

import copy
import gc
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mmpi_ns.bench.apart import Tell
from mmpi_ns.bench.gpu.checks import run_checks
from mmpi_ns.bench.methods import Method, Scene
from mmpi_ns.bench.speed.ops import copy_rate, median_s
from mmpi_ns.bench.speed.scaling import Point
from mmpi_ns.bench.suites import JOINT, TWO_PHASE, P
from mmpi_ns.bench.trainers import Steps
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.model import MMPIModel
from mmpi_ns.ops import dispatch, interpolate
from mmpi_ns.ops.march import Crossings, MarchOptions, march
from mmpi_ns.scene.geometry import plane_hits

SECTOR = 32
"""Bytes that a GPU fetches at least: a bilinear lookup of one channel touches two sectors, one in each row."""
TRANSPARENT = -30.0
"""A raw density through which no light is lost."""
KITTI = (4, 256, 270)
"""MPIs, planes, and texels a side of the paper's KITTI setting."""
FULL_WIDTH = 1242
"""Pixels across a frame of KITTI (375 down)."""


# Operations ----------------------------------------------------------------------------------------------------------


def rays_of(count: int, coherent: bool, device: str) -> dict[str, Tensor]:
    """Rays along the row of MPIs: of one image, or anywhere, as a training batch has them."""
    g = torch.Generator().manual_seed(0)
    if coherent:
        side = max(1, round(count**0.5))
        grid = torch.stack(torch.meshgrid(*[torch.linspace(0, 1, side)] * 2, indexing="xy"), -1).reshape(-1, 2)
        origins = torch.tensor([0.1, 0.1, 12.0]).expand(len(grid), 3)
    else:
        grid = torch.rand(count, 2, generator=g)
        origins = torch.rand(count, 3, generator=g) * torch.tensor([0.2, 0.2, 35.0])
    tangents = grid * torch.tensor([1.6, 0.5]) - torch.tensor([0.8, 0.25])
    directions = torch.nn.functional.normalize(torch.cat([tangents, torch.ones(len(grid), 1)], -1), dim=-1)
    one = torch.ones(len(grid), 1)
    parts = {"origins": origins, "directions": directions, "pixel_area": one, "nears": one, "fars": one * torch.inf}
    return {k: v.contiguous().to(device) for k, v in parts.items()}


def measure_operations(request: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """The march against the bandwidth of a copy, and each operation of a step by Triton and by plain torch."""
    device, small = request["device"], request["rehearse"]
    found: dict[str, Any] = {"copy_gb_per_s": copy_rate(device, 1 << (12 if small else 28)) / 1e9, "march": {}}
    tell(f"copy: {found['copy_gb_per_s']:.0f} GB/s")
    mpis, planes, side = (2, 8, 12) if small else KITTI
    plan = Point(mpis=mpis, planes=planes, height=side, width=side).plan()
    field = MMPIField(plan, feature_channels=1, hidden_width=2).eval()
    field = field.to(device)
    field.density.data.fill_(TRANSPARENT)
    repeats = 1 if small else 20
    for name, count, coherent in (("batch", 4096, False), ("large batch", 65_536, False), ("image", 466_000, True)):
        rays = rays_of(32 if small else count, coherent, device)
        found["march"][name] = _measure_march(field, rays, repeats)
        tell(f"march, {name}: {found['march'][name]}")
    found["ops"] = {}
    for name, work in _table_operations(device, 300 if small else 200_000).items():
        row = found["ops"][name] = {}
        for route in ("torch", "auto"):
            dispatch.choose(route)
            row["torch_ms" if route == "torch" else "triton_ms"] = 1e3 * median_s(work, repeats)
        tell(f"{name}: {row}")
    return found


@torch.no_grad()
def _measure_march(field: MMPIField, rays: dict[str, Tensor], repeats: int) -> dict[str, float]:
    """The kernel alone on rays that nothing stops and that keep nothing: it looks up every live sample."""
    hits = plane_hits(rays["origins"], rays["directions"], rays["nears"], rays["fars"], field.frames)
    live = int(hits.count.sum())
    at = Crossings(rays["origins"], rays["directions"], hits, hits.m_first, hits.count)
    seconds = median_s(lambda: march(field.layout, field.tables(), at, MarchOptions(0.9)), repeats)
    gb = 2 * SECTOR * live / 1e9
    return {
        "ms": 1e3 * seconds,
        "rays": len(rays["origins"]),
        "live_samples_a_ray": live / len(rays["origins"]),
        "gb_per_s": gb / seconds,
        "useful_gb_per_s": gb / 4 / seconds,
    }


def _table_operations(device: str, samples: int) -> dict[str, Callable[[], Any]]:
    """Those that read and write rows of 9 channels, at the sizes of an early training step."""
    g = torch.Generator().manual_seed(0)
    texels = 10 * samples
    table = torch.randn(texels, 9, generator=g).to(device)
    rows = torch.randint(0, texels, (samples // 3, 4), generator=g).repeat(3, 1).to(device)
    weights, values = (
        torch.rand(len(rows), 4, generator=g).to(device),
        torch.randn(len(rows), 9, generator=g).to(device),
    )

    def gradients() -> Tensor:
        index = interpolate.index_rows(rows, texels)
        return interpolate.sum_rows(index.position, values, weights, len(index.unique))

    return {
        "interpolate": lambda: interpolate.interpolate(table, rows, weights),
        "distinct rows": lambda: interpolate.index_rows(rows, texels),
        "distinct rows and their gradients": gradients,
    }


# Training ------------------------------------------------------------------------------------------------------------


def drive(planes: int, rays: int, *more: str) -> tuple[str, ...]:
    """Four MPIs by hand, trained together."""
    place = (P + "arrangement", "drive", P + "planes", str(planes), P + "max-planes", str(planes))
    return (*place, *JOINT, "--pipeline.datamanager.train-num-rays-per-batch", str(rays), *more)


def steps_of(request: dict[str, Any], name: str, method: Method, steps: int) -> Steps:
    """A trainer on the benchmark's scene, on a device that holds nothing of an earlier one."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    scene = Scene(Path(request["data"]), request["downscale_factor"])
    folder = Path(request["work"]) / name.replace(" ", "-")
    return Steps(method.words(scene, folder, steps, None, 0, request["device"]))


def measure_training(request: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Training rays/s, frames, memory and launches of a joint training of four MPIs, by one of the two paths."""
    small, found = request["rehearse"], {}
    total = 4 if small else 2000
    route = ("--pipeline.model.ops", "torch" if request["ops"] == "torch" else "auto")
    size = ("--pipeline.model.eval-num-rays-per-chunk", "2048" if small else str(1 << 17))
    sizes = (16,) if small else (4096, 16_384)
    for rays in sizes:
        ends = time.monotonic() + request["seconds"] / len(sizes)
        few = ("--pipeline.datamanager.keypoint-rays", "4") if small else ()
        options = drive(8 if small else 256, rays, *route, *size, *few)
        steps = steps_of(request, f"{request['ops']} {rays}", Method("mmpi", "mmpi", options), total)
        row = found[f"{rays} rays"] = train_for(steps, total, ends, tell)
        row |= {"rays_per_s": rays * row["late_steps_per_s"]}
        if rays == sizes[0]:
            row |= count_launches(steps) if torch.cuda.is_available() else {}
            row |= render_both(steps, request["ops"], 1 if small else 10)
        tell(f"{rays} rays: {row}")
        del steps
    return found


def train_for(steps: Steps, total: int, ends: float, tell: Tell) -> dict[str, Any]:
    """Trains until the run or the time is over; steps a second while resolution grows and after it."""
    model = steps.pipeline.model
    assert isinstance(model, MMPIModel)
    steps.run(2)  # compiles
    block, rows = max(1, total // 40), []
    while steps.step + block <= total and time.monotonic() < ends:
        young = not model.progress.schedule.sharpened(steps.step)
        rows.append((young, block / steps.run(block)))
    late = [rate for young, rate in rows if not young]
    early = [rate for young, rate in rows if young]
    return {
        "steps": steps.step,
        "early_steps_per_s": statistics.median(early) if early else None,
        "late_steps_per_s": statistics.median(late or early) if rows else 0.0,
        "texels": model.field.full_plan.texels,
        **memory(),
    }


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
def render_both(steps: Steps, ops: str, repeats: int) -> dict[str, Any]:
    """Milliseconds of a frame by the path that was trained; for Triton, its error against plain torch too."""
    pipeline = steps.pipeline
    pipeline.eval()
    camera, batch = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    truth = batch["image"][..., :3].to(pipeline.device)
    truth = truth.float() / 255 if truth.dtype == torch.uint8 else truth

    def render(view: Any = camera) -> Tensor:
        return pipeline.model.get_outputs_for_camera(view)["rgb"]

    frame_s, rgb = median_s(render, repeats), render()
    found = {"frame_ms": 1e3 * frame_s, "frame_pixels": rgb.shape[0] * rgb.shape[1], "psnr": _psnr(rgb, truth)}
    larger = copy.deepcopy(camera)
    larger.rescale_output_resolution(FULL_WIDTH / rgb.shape[1] if repeats > 1 else 0.5)
    found["full_frame_ms"] = 1e3 * median_s(lambda: render(larger), repeats)
    found["full_frame_pixels"] = int(larger.width) * int(larger.height)
    if ops != "torch":
        dispatch.choose("torch")
        plain = render()
        dispatch.choose("auto")
        found["largest_difference"] = float((rgb - plain).abs().max())
        found["psnr_delta_db"] = found["psnr"] - _psnr(plain, truth)
    pipeline.train()
    return found


def _psnr(rgb: Tensor, truth: Tensor) -> float:
    return float(-10 * torch.log10(((rgb - truth) ** 2).mean()))


def measure_kitti(request: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """``mmpi-kitti`` at the paper's size, its schedule run through in fewer steps; what 40,000 would take.

    Both readings of the paper's 30,000 individual steps: the MPIs share each batch, or each renders all of it.
    """
    found, small = {}, request["rehearse"]
    total = 3 if small else 1000
    for reading in ("split", "all"):
        ends = time.monotonic() + request["seconds"] / 2
        options = ("--pipeline.model.rays-per-mpi", reading)
        if small:
            options += (P + "planes", "6", P + "height", "12", P + "width", "12", *TWO_PHASE)
            options += ("--pipeline.datamanager.train-num-rays-per-batch", "16")
        steps = steps_of(request, f"kitti {reading}", Method("mmpi-kitti", "mmpi-kitti", options), total)
        found[reading] = time_phases(steps, total, ends)
        tell(f"{reading}: {found[reading]}")
        del steps
    return found


def time_phases(steps: Steps, total: int, ends: float) -> dict[str, Any]:
    """Mean seconds of a step at each resolution and phase, and the minutes of 40,000 steps with those shares.

    A step whose stage was not reached within the time is given the mean of the last stage that was.
    """
    model, times = steps.pipeline.model, {}
    schedule = model.progress.schedule
    stages = [(schedule.phase_at(s).name, schedule.texel_factor(s)) for s in range(total)]
    steps.run(1)
    block = max(1, total // 100)
    while steps.step < total and time.monotonic() < ends:
        stage = stages[steps.step]
        count = 1
        while count < block and steps.step + count < total and stages[steps.step + count] == stage:
            count += 1
        times.setdefault(stage, []).append(steps.run(count) / count)
    means, last = {}, 0.0
    for stage in dict.fromkeys(stages):
        # The median: the first steps of a stage compile kernels and resample tables.
        means[stage] = last = statistics.median(times[stage]) if stage in times else last
    mean_s = sum(means[s] for s in stages) / total
    return {
        "step_ms": {f"{name}, {factor:.3g} of the texels": 1e3 * s for (name, factor), s in means.items()},
        "steps_run": steps.step,
        "reached_the_end": steps.step >= total,
        "steps_per_s": 1 / mean_s if mean_s else 0.0,
        "minutes_of_40000_steps": mean_s * 40_000 / 60,
        "parameters": sum(p.numel() for p in model.parameters()),
        **memory(),
    }


def check(request: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Correctness first."""
    found = run_checks(request["device"], request["rehearse"])
    for row in found["checks"]:
        if not row["ok"]:
            tell(f"FAIL {row}")
    return found


PARTS: dict[str, Callable[[dict[str, Any], Tell], dict[str, Any]]] = {
    "checks": check,
    "operations": measure_operations,
    "training": measure_training,
    "kitti": measure_kitti,
}


def run_part(request: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """One part, as asked."""
    if request["rehearse"]:
        torch.set_num_threads(1)
        dispatch.interpret(True)
    found = PARTS[request["part"]](request, tell)
    return {**found, "device": _device_name()}


def _device_name() -> str:
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU (rehearsal by Triton's interpreter)"
