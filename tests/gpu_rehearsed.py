"""``benchmarks/gpu.py --rehearse`` in one process: run by test_bench_gpu.py with TRITON_INTERPRET=1."""

from __future__ import annotations

import json
import math

import gpu
import kernel_checks
from gpu import SHARES, Gpu
from gpu_parts import interpret
from random_scenes import random_scene

from mmpi_ns.ops import dispatch


def part_here(work, request, folder, threads, seconds, extra):
    assert seconds > 0 and extra["TRITON_INTERPRET"] == "1"
    dispatch.choose("auto")
    return work(request, lambda text: None)


def test_all_parts_end_to_end(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "run_apart", part_here)
    Gpu(output=tmp_path / "results", work=tmp_path / "work", rehearse=True).run()
    found = json.loads((tmp_path / "results" / "gpu.json").read_text())
    assert set(found["rows"]) == set(SHARES) and found["rehearsal"]
    assert not [p for p in found["rows"].values() if "not_run" in p]
    print({name: round(part["wall_s"], 1) for name, part in found["rows"].items()})
    head = found["headline"]
    wanted = {"checks", "failed_checks", "copy_gb_per_s"}
    wanted |= {"rays_per_s", "torch_rays_per_s", "frame_ms", "torch_frame_ms", "full_frame_ms", "psnr_delta_db"}
    wanted |= {"kitti_split_steps_per_s", "kitti_all_minutes_of_40000_steps"}
    assert wanted <= set(head) and all(math.isfinite(v) for v in head.values())
    assert head["failed_checks"] == 0 and head["checks"] > 12 and abs(head["psnr_delta_db"]) < 0.01
    text = (tmp_path / "results" / "gpu.md").read_text()
    assert "no number here is a measurement" in text and "Not run" not in text


def test_wrong_kernels_are_found(monkeypatch):
    interpret(True)
    assert all(c.ok for c in kernel_checks.variations("cpu", 50))
    wrong = {
        "total_variation": lambda values, *rest: variation(2 * values, *rest),
        "march": lambda *given: march(*given[:-1], given[-1]._replace(blends=False)),  # without blending
    }
    right, (march, variation) = dispatch.function, (dispatch.function(n, "gpu") for n in ("march", "total_variation"))
    monkeypatch.setattr(
        dispatch, "function", lambda name, form: wrong[name] if form == "gpu" and name in wrong else right(name, form)
    )
    assert not any(c.ok for c in kernel_checks.variations("cpu", 50))
    s = random_scene(2, 4, True).clear()
    assert len(s.bundle) >= 2 and not all(c.ok for c in kernel_checks.marched(s, "wrong", s.exact()))
