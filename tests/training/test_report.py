"""What a training run says of itself (training/report.py)."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import torch
from training_runs import schedule_of

from mmpi_ns.rendering.pipeline import summary
from mmpi_ns.training import report
from mmpi_ns.utils import machine
from mmpi_ns.utils.errors import duration


def lines_of(monkeypatch, capsys, steps, seconds_a_step, **how):
    """What is said of a run whose steps take so long, the first of them a minute longer."""
    now = [0.0]
    monkeypatch.setattr(report, "monotonic", lambda: now[0])
    settings = {"blend_share": 0.25, "finetune_share": 0.25, "growth_shares": (), "decay_decades": 1.0} | how
    schedule = schedule_of("two-phase", steps, **settings)
    log = report.TrainingLog(schedule, 1000, 0, steps)
    for step in range(steps):
        now[0] += seconds_a_step + (60 if step == 0 else 0)
        log.note(step, torch.tensor(0.01, requires_grad=True))
    return capsys.readouterr().out.splitlines()


def test_the_next_commands_can_be_copied_from_any_folder():
    _, *commands = report.next_commands(Path("/my photos/r")).splitlines()
    assert [shlex.split(line)[shlex.split(line).index("--load-config") + 1] for line in commands] == [
        "/my photos/r/config.yml"
    ] * 3


def test_a_line_says_phase_speed_psnr_and_time_left(monkeypatch, capsys):
    lines = lines_of(monkeypatch, capsys, 400, 0.5)
    assert lines[0] == "step 10 of 400 | individual | 2,000 rays/s | batch PSNR 20.0 dB | 3 min left"
    assert lines[-1] == "step 400 of 400 | finetune | 2,000 rays/s | batch PSNR 20.0 dB | 0 s left"
    assert 40 <= len(lines) <= 44
    assert any(line.startswith("step 201 of 400 | blend") for line in lines), "a phase begins"


def test_lines_are_neither_dense_nor_half_a_minute_apart(monkeypatch, capsys):
    assert len(lines_of(monkeypatch, capsys, 400, 0.01)) <= 5
    slow = lines_of(monkeypatch, capsys, 40, 40.0)
    assert len(slow) == 31  # every step from the tenth on


def test_durations_are_in_words():
    assert [duration(s) for s in (3.2, 89, 641, 12600)] == ["3 s", "89 s", "11 min", "3.5 h"]


def test_a_long_run_without_a_gpu_names_the_smaller_method():
    alone = report.forecast("mmpi", 20000, 4096, 1, 1.0)
    assert f"{20000 * 4096 / report.CPU_RAYS / 3600:.1f} h" in alone and "mmpi-small" in alone
    assert "mmpi-small" not in report.forecast("mmpi-small", 20000, 4096, 1, 1.0)


def test_more_threads_help_with_what_is_parallel_alone():
    for threads, share in ((2, 0.8), (16, 0.6 + 0.4 / 16)):
        assert f"about {100 * share:.1f} h" in report.forecast("mmpi", 360_000, int(report.CPU_RAYS), threads, 16.0)


def test_threads_that_wait_for_cores_are_told():
    assert "free" not in report.forecast("mmpi", 10, 10, 8, 7.8)
    assert "free" not in report.forecast("mmpi", 10, 10, 1, 0.2), "nothing would mend it"
    busy = report.forecast("mmpi", 10, 10, 8, 2.1)
    assert "8 threads run and 2.1 cores are free" in busy and "OMP_NUM_THREADS=2" in busy
    assert report.forecast("mmpi", 10**6, 10, 8, 2.0).split("\n")[0] == report.forecast("mmpi", 10**6, 10, 2, 2.0)


def test_free_cores_are_those_that_are_idle_within_what_the_process_may_use(monkeypatch, tmp_path):
    now = iter([100, 160, 100, 1000, 5, 5])
    monkeypatch.setattr(machine, "STAT", tmp_path / "stat")
    monkeypatch.setattr(machine, "CGROUP", tmp_path)
    monkeypatch.setattr(machine.os, "sched_getaffinity", lambda _: range(8), raising=False)

    def ticks():
        machine.STAT.write_text(f"cpu 9 9 9 {next(now) - 5} 5 9 9 9\ncpu0 1 2\n")
        return idle()

    idle = machine._idle_ticks
    monkeypatch.setattr(machine, "_idle_ticks", ticks)
    monkeypatch.setattr(machine.time, "sleep", lambda _: None)
    monkeypatch.setattr(machine.os, "sysconf", lambda _: 100)
    assert machine.free_cores(0.2) == pytest.approx(3.0)
    (tmp_path / "cpu.max").write_text("400000 100000\n")
    assert machine.free_cores(0.2) == 4, "no more than the container has"
    assert machine.free_cores(0.2) == 0


def test_evaluation_is_summed_up_in_a_line():
    found = [("a.png", {"psnr": 20.0, "ssim": 0.5}), ("b.png", {"psnr": 24.0, "ssim": 0.7}), ("c.png", {"psnr": 25.0})]
    assert summary(found) == (
        "3 images: PSNR 23.00 dB (worst 20.00, a.png; best 25.00, c.png), SSIM 0.600 (0.500 to 0.700)"
    )
    assert summary([("a.png", {"psnr": 20.0})]) == "1 images: PSNR 20.00 dB (worst 20.00, a.png; best 20.00, a.png)"


@pytest.mark.parametrize("steps", [12, 400])
def test_the_last_step_has_a_line(monkeypatch, capsys, steps):
    assert lines_of(monkeypatch, capsys, steps, 0.001)[-1].startswith(f"step {steps} of {steps} |")
