"""``mmpi-bench gpu`` without a GPU: rehearsed in miniature, and what it says where it cannot measure."""

from __future__ import annotations

import re
from types import SimpleNamespace

import pytest
import torch
from triton_processes import HERE, needs_triton, python

from mmpi_ns.bench.apart import run_apart
from mmpi_ns.bench.gpu import command as gpu
from mmpi_ns.bench.gpu.command import Gpu, told_curve
from mmpi_ns.bench.gpu.report import headline, markdown


@needs_triton
@pytest.mark.commands
def test_rehearsal():
    found = python("-m", "pytest", "-p", "no:cacheprovider", str(HERE / "gpu_rehearsed.py"), TRITON_INTERPRET="1")
    assert found.returncode == 0, found.stdout[-6000:] + found.stderr[-2000:]
    assert re.search(r"2 passed", found.stdout) and "skipped" not in found.stdout


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU, which the command would measure")
def test_without_a_gpu_one_sentence_and_a_status(tmp_path):
    found = python("-m", "mmpi_ns.bench", "gpu", "--output", str(tmp_path))
    assert found.returncode == 1 and "torch sees none" in found.stderr and not list(tmp_path.iterdir())
    assert "Traceback" not in found.stderr and "--rehearse" in found.stderr


def test_mistakes_are_named(tmp_path):
    with pytest.raises(ValueError, match="no part 'chekcs'"):
        Gpu(parts=("chekcs",)).run()
    with pytest.raises(ValueError, match="no scene at"):
        Gpu(data=tmp_path / "nowhere", rehearse=True).run()


def test_a_part_that_fails_takes_no_other_with_it(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    answers = {
        "checks": {"not_run": "it failed with status 1"},
        "operations": {"copy_gb_per_s": 5.0, "march": {}, "ops": {}},
    }
    monkeypatch.setattr(gpu, "run_apart", lambda work, request, *_: answers[request["part"]])
    Gpu(data=tmp_path, output=tmp_path, work=tmp_path, parts=("checks", "operations")).run()
    text = (tmp_path / "gpu.md").read_text()
    assert "Not run: it failed with status 1" in text and "5 GB/s" in text


def test_a_kernel_that_is_wrong_ends_with_a_status(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    bad = {"name": "march", "error": 1.0, "bound": 0.0, "ok": False}
    monkeypatch.setattr(gpu, "run_apart", lambda *_: {"checks": [bad], "failed": 1})
    with pytest.raises(SystemExit, match="a kernel is wrong"):
        Gpu(data=tmp_path, output=tmp_path, work=tmp_path, parts=("checks",)).run()
    assert "| march | 1 | 0 | FAIL |" in (tmp_path / "gpu.md").read_text()


def test_a_process_that_outlasts_its_time_is_ended(tmp_path, monkeypatch):
    lines = ("import time", "print('@ step 3: 7 s of training, 12.50 dB', flush=True)", "time.sleep(90)")
    (tmp_path / "sleeper.py").write_text("\n".join(lines))
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{HERE.parent}")
    sleep = SimpleNamespace(__module__="sleeper", __qualname__="sleep")
    found = run_apart(sleep, {}, tmp_path / "run", 1, seconds=20.0)
    assert "failed with status" in found["not_run"]
    assert told_curve(tmp_path / "run") == [{"step": 3, "seconds": 7.0, "psnr": 12.5}]
    assert told_curve(tmp_path / "nothing") == []


def test_headline_holds_what_was_measured_and_nothing_else():
    assert headline({"checks": {"not_run": "no time"}}) == {}
    row = {"rays_per_s": 2.0, "frame_ms": 5.0, "peak_gib": 1.0}
    parts = {"training triton": {"4096 rays": row, "16384 rays": {**row, "rays_per_s": 3.0}, "device": "GPU"}}
    assert headline(parts) == {"rays_per_s": 3.0, "peak_gib": 1.0, "frame_ms": 5.0}
    curve = [{"step": 1, "seconds": 2.0, "psnr": 20.0}]
    quality = {"methods": {"mmpi": {"curve": curve}, "nerfacto": {"not_run": "no"}}}
    assert headline({"quality": quality}) == {"mmpi_psnr_db": 20.0, "mmpi_seconds": 2.0}
    made = {"command": "mmpi-bench gpu", "processor": "x", "threads": 1, "torch": "2", "commit": "c", "date": "d"}
    content = {"rows": {"quality": {**quality, "wall_s": 1.0}}, "made": made, "rehearsal": False}
    assert "| nerfacto | - | - | not run: no |" in markdown(content, {}) and "rehearsal" not in markdown(content, {})
