"""``mmpi-bench gpu`` and ``benchmarks/gpu.py`` without a GPU: rehearsed, and what they say where none can be tried."""

from __future__ import annotations

import json
import re
import sys
from types import SimpleNamespace

import gpu
import gpu_parts as parts
import gpu_session
import kernel_checks as checks
import pytest
import torch
from apart import run_apart
from gpu import Gpu
from methods import METHODS
from triton_processes import HERE, needs_triton, python

from mmpi_ns.bench import gpu as command
from mmpi_ns.ops import dispatch
from mmpi_ns.ops.layout import EVERY

PRINTED = r"a step of \d+ rays: [\d.]+ ms, [\d,]+ rays/s|a frame of \d+ pixels: .* frames/s|memory: [\d.]+ GiB"
TIMED = {"step_ms": 1.0, "frame_ms": 2.0, "pixels": 3, "peak_gib": 0.5}


@needs_triton
@pytest.mark.commands
def test_rehearsal():
    found = python("-m", "pytest", "-p", "no:cacheprovider", str(HERE / "gpu_rehearsed.py"), TRITON_INTERPRET="1")
    assert found.returncode == 0, found.stdout[-6000:] + found.stderr[-2000:]
    assert re.search(r"2 passed", found.stdout) and "skipped" not in found.stdout


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU, which the command would measure")
def test_without_a_gpu_one_sentence_and_a_status(tmp_path):
    found = python("-m", "mmpi_ns.scripts.bench", "gpu", "--folder", str(tmp_path))
    assert found.returncode == 1 and "torch sees no CUDA device" in found.stderr and not list(tmp_path.iterdir())
    assert "Traceback" not in found.stderr and "--quick" in found.stderr
    with pytest.raises(ValueError, match=r"torch sees none.*--rehearse"):
        Gpu(output=tmp_path).run()


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU, of which more would be said")
@pytest.mark.commands
def test_a_quick_look_without_a_gpu_ends_in_an_honest_sentence(tmp_path):
    found = python("-m", "mmpi_ns.scripts.bench", "gpu", "--quick", "--folder", str(tmp_path))
    said = found.stdout.strip().splitlines()
    assert found.returncode == 0 and "only a machine with one can say" in said[-1], found.stdout + found.stderr
    assert (
        any("torch sees no GPU" in line for line in said) and sum(bool(re.match(PRINTED, line)) for line in said) == 3
    )
    rows = json.loads((tmp_path / "gpu.json").read_text())
    assert rows["device"] == "cpu" and not rows["well"] and rows["timed"]["step_ms"] > 0


@pytest.mark.parametrize("work", [checks.interpolation, checks.distinct_rows, checks.variations, checks.adam])
def test_checks_pass_on_the_forms_of_this_machine(work):
    """They compare whatever runs with float64, here the compiled forms of a CPU."""
    assert dispatch.form_of("total_variation", torch.zeros(1)) == "cpu"
    found = work("cpu", 500)
    assert found and all(c.ok for c in found), found


@pytest.mark.parametrize("slots", [16, 64, 300, 1000])
def test_compositing_is_checked_at_every_width(slots):
    assert all(c.ok for c in checks.compositing_kernels("cpu", 50, slots))


def test_a_full_look_tries_every_shape_afresh(monkeypatch, tmp_path):
    tried = []
    monkeypatch.setattr(dispatch, "expect", lambda shapes, afresh: tried.append((shapes, afresh)))
    monkeypatch.setattr(
        dispatch, "fault", lambda name: "wrong" if tried[-1][0] == EVERY[0] and name == "march" else None
    )
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(command, "environment", dict)
    monkeypatch.setattr(command, "time_training", lambda *_: TIMED)
    command.Gpu(folder=tmp_path).main()
    found = json.loads((tmp_path / "gpu.json").read_text())["operations"]
    assert tried == [(shapes, True) for shapes in EVERY] and len(found) == 4
    assert {name for name, reason in found.items() if reason} == {"march"}, "what failed once has failed"
    assert {1, 2, 5, 9, 33} <= set(EVERY[0].mpis) and EVERY[0].blends


def test_a_quick_look_names_what_falls_back(monkeypatch, capsys, tmp_path):
    reason = "its Triton kernel fails on this device (CompilationError: at 3:4)"
    names = [name for name, each in dispatch.operations().items() if "gpu" in each.compiled]
    for faults, wanted in (
        ({}, "All is well"),
        ({"march": reason}, "1 operation(s) run in plain torch, several times slower: march."),
    ):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(command, "environment", dict)
        monkeypatch.setattr(command, "time_training", lambda *_: TIMED)
        monkeypatch.setattr(dispatch, "expect", lambda *_, **__: None)
        monkeypatch.setattr(dispatch, "_faults", dict.fromkeys(names) | faults)
        command.Gpu(quick=True, folder=tmp_path).main()
        found = json.loads((tmp_path / "gpu.json").read_text())
        said = capsys.readouterr().out
        assert found["well"] == (not faults) and wanted in said.splitlines()[-1]
        assert not faults or f"march: plain torch, since {reason}" in said


def test_mistakes_are_named(tmp_path):
    with pytest.raises(ValueError, match="no part 'chekcs'"):
        Gpu(parts=("chekcs",)).run()
    with pytest.raises(ValueError, match="no scene at"):
        Gpu(data=tmp_path / "nowhere", rehearse=True).run()


def test_a_part_that_fails_takes_no_other_with_it(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    answers = {
        "checks": {"not_run": "it failed with status 1"},
        "kitti": {"headline": {"steps_per_s": 5.0}, "tables": {"The paper's KITTI size": {}}},
    }
    monkeypatch.setattr(gpu, "run_apart", lambda work, request, *_: answers[request["part"]])
    Gpu(data=tmp_path, output=tmp_path, work=tmp_path, parts=("checks", "kitti")).run()
    text = (tmp_path / "gpu.md").read_text()
    assert "Not run: it failed with status 1" in text and "KITTI size" in text and "| steps_per_s | 5 |" in text


def test_a_kernel_that_is_wrong_ends_with_a_status(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    bad = {"name": "march", "error": 1.0, "bound": 0.0, "ok": False}
    monkeypatch.setattr(parts, "run_checks", lambda *_: {"checks": [bad], "failed": 1})
    monkeypatch.setattr(gpu, "run_apart", lambda work, request, *_: parts.check(request, print))
    with pytest.raises(SystemExit, match="a kernel is wrong"):
        Gpu(data=tmp_path, output=tmp_path, work=tmp_path, parts=("checks",)).run()
    assert "| march | 1 | 0 | FAIL |" in (tmp_path / "gpu.md").read_text()


def test_a_process_that_outlasts_its_time_is_ended(tmp_path, monkeypatch):
    lines = ("import time", "print('@ step 3: 7 s of training, 12.50 dB', flush=True)", "time.sleep(90)")
    (tmp_path / "sleeper.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    sleep = SimpleNamespace(__module__="sleeper", __qualname__="sleep")
    found = run_apart(sleep, {}, tmp_path / "run", 1, seconds=20.0)
    assert "failed with status" in found["not_run"]
    assert "@ step 3: 7 s of training" in (tmp_path / "run" / "output.log").read_text()


def test_a_session_writes_what_each_part_said_also_where_one_is_cut_off(tmp_path, monkeypatch, capsys):
    words = [[sys.executable, "-c", "print('well')"], ["no-such-command"]]
    words += [[sys.executable, "-c", "import time; print('begun', flush=True); time.sleep(90)"], words[0]]
    words += [[sys.executable, "-c", "print('not run: it failed with status 1')"]]
    made = [
        gpu_session.Part(name, w, 60 if name != "slow" else 5)
        for name, w in zip("a missing slow b unrun".split(), words, strict=True)
    ]
    monkeypatch.setattr(gpu_session, "parts", lambda *_: made)
    monkeypatch.setattr(sys, "argv", ["gpu_session.py", "--data", str(tmp_path), "--out", str(tmp_path / "out")])
    assert gpu_session.main() == 1
    found = json.loads((tmp_path / "out" / "session.json").read_text())["parts"]
    assert [(p["status"], p.get("ran_out_of_time", False)) for p in found.values()] == [
        (0, False), (None, False), (-9, True), (0, False), (1, False),
    ]  # fmt: skip
    assert found["slow"]["output"] == "begun\n" and "FileNotFoundError" in found["missing"]["output"]
    assert capsys.readouterr().out.count("status") == 5


def test_a_session_trains_at_full_size_and_ends_within_ten_minutes(tmp_path):
    made = gpu_session.parts(tmp_path, tmp_path, tmp_path, rehearse=False)
    assert {p.name for p in made} > {
        "device",
        "quick",
        "tests",
        "bench gpu",
        *(f"train {name}" for name in METHODS if name in gpu_session.TRAININGS),
    }
    assert set(gpu_session.TRAININGS) < set(METHODS)
    for part in made:
        assert not part.name.startswith("train") or {"cuda", "1"} < set(part.words)


def test_headline_holds_what_was_measured_and_nothing_else(tmp_path, monkeypatch):
    paces = iter([2.0, 3.0])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(parts, "steps_of", lambda *_: None)
    monkeypatch.setattr(parts, "train_for", lambda *_: {"late_steps_per_s": next(paces)})
    monkeypatch.setattr(parts, "render_both", lambda *_: {"frame_ms": 5.0, "psnr": 9.0})
    monkeypatch.setattr(parts, "copy_rate", lambda *_: 1e9)
    request = {"rehearse": False, "ops": "torch", "device": "cpu", "seconds": 1.0}
    found = parts.measure_training(request, lambda _: None)
    assert found["headline"] == {"torch_rays_per_s": 3.0 * 16_384, "torch_frame_ms": 5.0}
    assert [list(rows) for rows in found["tables"].values()] == [["4096 rays", "16384 rays"]]
