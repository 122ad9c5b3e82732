"""Steps on a GPU, one operation at a time and as CUDA graphs, alternating in one process: a part of gpu_session.py.

    python benchmarks/gpu_steps.py costs --out FILE
    python benchmarks/gpu_steps.py mmpi-small --data CAPTURE --steps 1000 --stages 60 500 --out FILE

What it found is written after every stage.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile
from trainers import BARE, Scene, Steps, clock, train_words

NODES = (1, 100, 700)
"""Of graphs whose replay is timed."""
STEPS, ROUNDS = 20, 3
"""Of each way, and how often they alternate."""
PROFILED = 4


def microseconds(work, count=1000) -> list[float]:
    """Of a call, until it returns and until the GPU has done it; the least of three rounds."""
    work()
    rounds = []
    for _ in range(3):
        start = clock()
        for _ in range(count):
            work()
        returned = time.perf_counter() - start
        rounds.append((returned, clock() - start))
    return [round(1e6 * min(r[i] for r in rounds) / count, 2) for i in (0, 1)]


def costs(device: str) -> dict:
    """Of a launch and of a node of a graph."""
    x, y = torch.ones(2, 1024, device=device)
    out, leaf = torch.empty_like(x), torch.ones(1024, device=device, requires_grad=True)
    results = {"add": microseconds(lambda: torch.add(x, y, out=out)), "add, new": microseconds(lambda: x + y)}
    results["add, forward and backward"] = microseconds(lambda: torch.autograd.grad((leaf + y).sum(), leaf))
    for nodes in NODES if device == "cuda" else ():
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            for _ in range(nodes):
                torch.add(x, y, out=out)
        results[f"graph of {nodes}"] = microseconds(graph.replay, 100)
    return results


def busy(steps: Steps) -> dict:
    """Milliseconds that the GPU works in a step, its kernels, the largest of them, and what is waited for."""
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as results:
        steps.run(PROFILED)
    on_gpu = [e for e in results.key_averages() if e.device_type == torch.autograd.DeviceType.CUDA]
    on_gpu.sort(key=lambda e: -e.self_device_time_total)
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as intro:
        warnings.simplefilter("always")
        steps.run(1)
    torch.cuda.set_sync_debug_mode("default")
    return {
        "busy_ms": sum(e.self_device_time_total for e in on_gpu) / PROFILED / 1e3,
        "kernels": sum(e.count for e in on_gpu) / PROFILED,
        "largest_ms": {e.key[:80]: e.self_device_time_total / PROFILED / 1e3 for e in on_gpu[:20]},
        "waits": [f"{Path(w.filename).name}:{w.lineno}" for w in intro if "synchroniz" in str(w.message)],
    }


def alternating(steps: Steps) -> dict:
    """Milliseconds of a step by both ways, and their profiles."""
    trainer, graphs = steps.trainer, steps.trainer._graphs
    results: dict = {"by operations": {"ms": []}, "graphs": {"ms": []}}
    for _ in range(ROUNDS):
        for name, each in (("by operations", None), ("graphs", graphs)):
            trainer._graphs = each
            steps.run(8)  # what is not recorded is measured and recorded
            results[name]["ms"].append(1e3 * steps.run(STEPS) / STEPS)
    for name, each in (("by operations", None), ("graphs", graphs)) if torch.cuda.is_available() else ():
        trainer._graphs = each
        steps.run(4)
        results[name] |= busy(steps)
    trainer._graphs = graphs
    if graphs is not None:
        results |= {
            "off": graphs.is_off,
            "repeated": graphs.repeated,
            "lost": graphs.lost,
            "room": str(graphs.capacity),
        }
    return results


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("what", help="costs, or a method")
    options.add_argument("--data", type=Path)
    options.add_argument("--downscale-factor", type=int, default=1)
    options.add_argument("--steps", type=int, default=1000, help="of the whole run")
    options.add_argument("--stages", type=int, nargs="*", default=[], help="steps after which both ways alternate")
    options.add_argument("--out", type=Path, required=True, help="a JSON file")
    given, device = options.parse_args(), "cuda" if torch.cuda.is_available() else "cpu"
    results: dict = {}

    def note(name, value) -> None:
        results[name] = value
        given.out.write_text(json.dumps(results, indent=1), encoding="utf-8")
        print(name, value, flush=True)

    if given.what == "costs":
        note("microseconds, returned and done", costs(device))
        return
    with tempfile.TemporaryDirectory() as folder:
        scene, start = Scene(given.data, given.downscale_factor), clock()
        steps = Steps(train_words(given.what, BARE, scene, Path(folder), given.steps, 0, device))
        note("set up, s", clock() - start)
        for stage in (*given.stages, given.steps):
            if stage > steps.step:
                count = stage - steps.step
                note(f"ms a step, {steps.step} to {stage}", 1e3 * steps.run(count) / count)
            if stage < given.steps:
                note(f"at {steps.step}", alternating(steps))
        steps.render()
        note("ms a frame", [1e3 * steps.render()[0] for _ in range(5)])
        if device == "cuda":
            note("GiB at most", torch.cuda.max_memory_reserved() / 2**30)


if __name__ == "__main__":
    main()
