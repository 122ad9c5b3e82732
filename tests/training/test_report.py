"""What a training run says of itself (training/report.py)."""

from __future__ import annotations

import shlex
from pathlib import Path

import torch
from training_runs import schedule_of

from mmpi_ns.training import report


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
