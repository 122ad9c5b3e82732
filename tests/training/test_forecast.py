"""What is said of a run before and during it: memory, and how long it takes (forecast.py)."""

from __future__ import annotations

import re
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made import make_mpi
from training_runs import datamanager, load, ready, trainer_config, write_plan

from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.scene.windows import Window, WindowedPlan
from mmpi_ns.training import trainer as mmpi_trainer
from mmpi_ns.training.forecast import FEWEST, SKIPPED, Forecast, describe, duration
from mmpi_ns.training.phases import make_schedule

# Memory --------------------------------------------------------------------------------------------------------------


def bytes_of(state) -> int:
    """Tensors of a field's tables and of their moments in a checkpoint."""
    field = {k.removeprefix("_model.field."): v for k, v in state["pipeline"].items() if "_model.field." in k}
    tables = sum(
        v.nbytes for k, v in field.items() if k not in ("networks.weights", "plan_bytes", "crossings", "texel_factor")
    )
    moments = [state["optimizers"][k]["state"].get(0, {}) for k in ("density", "features", "reliability")]
    return tables + sum(m[k].nbytes for m in moments for k in m if k != "step")


@pytest.mark.parametrize("training", ["joint", "two-phase"])
def test_memory_is_that_of_tables_moments_and_pixels(scene, plan_file, tmp_path, training, capsys):
    """Joint training reaches what was told to the byte; before reliability is learned bricks no ray read are given
    up, so two phases stay below it."""
    trainer = ready(trainer_config(scene, plan_file, tmp_path, 16, training=training))
    said = " ".join(capsys.readouterr().out.split())
    tables, pixels = trainer._expected_memory()
    trainer.train()
    most = max(bytes_of(load(trainer.checkpoint_dir, step)) for step in range(1, 16))
    assert most == tables[0] if training == "joint" else 0.5 * tables[0] < most <= tables[0]
    pool = trainer.pipeline.datamanager.pool
    assert pixels == [pool.colors.nbytes + pool.indices.nbytes]
    told = re.search(r"Memory in training: at most ([\d.]+) GiB", said)
    assert told and float(told[1]) == pytest.approx((tables[0] + pixels[0]) / 2**30, abs=0.006)


def test_pixels_read_window_by_window_count_for_that_window(scene):
    by_window = datamanager(scene, resident_pixels=0)
    cameras = np.array([1, 2, 5])
    told = by_window.pixel_bytes(cameras), by_window.pixel_bytes()
    by_window.use_cameras(cameras)
    assert told[0] == by_window.pool.colors.nbytes + by_window.pool.indices.nbytes < told[1]
    at_once = datamanager(scene)
    assert at_once.pixel_bytes(cameras) == at_once.pixel_bytes() == told[1]


def test_the_largest_window_decides_what_memory_is_told():
    plan = ScenePlan((make_mpi(),), None, 0.05, 1.5)
    windows = WindowedPlan(tuple(Window((x, 0.0, 0.0), 1.0, 0.1, plan) for x in (0.0, 2.0)))
    said = describe(windows, 40, [2 * 2**30, 3 * 2**30], [2**30, 2**29])
    assert "2 windows of 40 steps" in said and "at most 3.50 GiB (tables and moments 3.00, pixels 0.50)" in said


# Time ----------------------------------------------------------------------------------------------------------------


def cost(schedule, step) -> float:
    """A machine on which steps cost more with every doubling of the texels, and less once surfaces have formed."""
    name, factor = schedule.phase_at(step).name, schedule.texel_factor(step)
    return (
        {"joint": 0.2, "individual": 0.1, "blend": 0.05, "finetune": 0.15}[name]
        * (1 + factor)
        * (0.5 if schedule.sharpened(step) else 1.0)
    )


def told_by(schedule, spans):
    """(step, sentence, seconds that were really left) of everything that is said on the way."""
    forecast, found = Forecast(schedule, spans), []
    steps = [s for span in spans for s in span]
    for i, step in enumerate(steps):
        said = forecast.note(step, cost(schedule, step))
        if said:
            found.append((step, said, forecast.seconds_left(step), sum(cost(schedule, s) for s in steps[i + 1 :])))
    return found


def test_a_run_is_told_after_a_hundredth_and_again_when_surfaces_have_formed():
    schedule = make_schedule("joint", 3000)
    first, second = told_by(schedule, [range(3000)])
    assert first[0] == SKIPPED + 30 - 1 and second[0] == schedule.growth[-1] + 30 - 1
    assert "said anew when resolution has grown" in first[1] and "said anew" not in second[1]
    assert first[2] == pytest.approx((3000 - first[0] - 1) * 0.2 * (1 + 1 / 16))
    assert second[2] == pytest.approx(second[3]) and f"about {duration(second[3])} to go." in second[1]


def test_each_phase_is_told_when_it_has_begun():
    schedule = make_schedule("two-phase", 4000, blend_share=0.25, finetune_share=0.25)
    told = told_by(schedule, [range(4000)])
    assert [schedule.phase_at(t[0]).name for t in told] == ["individual", "individual", "blend", "finetune"]
    assert told[-1][2] == pytest.approx(told[-1][3])


def test_windows_cost_what_the_first_one_did_and_are_told_no_more():
    schedule = make_schedule("joint", 1000, windows=5)
    told = told_by(schedule, [range(w * 1000, (w + 1) * 1000) for w in (1, 3)])
    assert len(told) == 2 and told[1][0] < 2000
    assert told[1][2] == pytest.approx(told[1][3], rel=0.02), "all stages but a few first steps were timed"


def test_a_pause_is_not_taken_for_the_cost_of_a_step():
    schedule = make_schedule("joint", 3000, growth_shares=())
    forecast = Forecast(schedule, [range(3000)])
    for step in range(SKIPPED + 40):
        forecast.note(step, 600.0 if step == 20 else 0.1)
    assert forecast.seconds_left(step) == pytest.approx((2999 - step) * 0.1, rel=0.2)


def test_a_run_that_is_over_at_once_is_told_nothing():
    assert not told_by(make_schedule("joint", SKIPPED + FEWEST - 1, growth_shares=()), [range(SKIPPED + FEWEST - 1)])


@pytest.mark.parametrize(
    "seconds, words",
    [(4.4, "4 seconds"), (89, "89 seconds"), (90, "1.5 minutes"), (1500, "25 minutes"), (9000, "2.5 hours")],
)
def test_durations_in_words(seconds, words):
    assert duration(seconds) == words


def test_the_trainer_times_its_steps_and_says_so(scene, tmp_path, monkeypatch, capsys):
    """On a clock that goes on by a minute with every step, from where a checkpoint was left."""
    plan = write_plan(scene, tmp_path / "plan.json", num_mpis=1)
    ticks = count(step=60.0)
    monkeypatch.setattr(mmpi_trainer, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    config = trainer_config(scene, plan, tmp_path / "a", 40, growth_shares=())
    ready(config).train()
    said = " ".join(capsys.readouterr().out.split())
    told = re.findall(r"After step (\d+): about (\d+) minutes to go", said)
    assert "How long it takes is said as soon as some steps were timed." in said
    assert [(int(step), int(left)) for step, left in told] == [(21, 19)], said[-1500:]
