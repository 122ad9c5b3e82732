"""A run that was interrupted ends as the uninterrupted one does, bit for bit; checkpoints are never half written."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from training_runs import compared, differences, load, ready, trainer_config, write_plan

from mmpi_ns.field.tables import in_half_precision
from mmpi_ns.scene.windows import WindowedPlan

STEPS = 24
"""individual 0-11 with doublings at 2 and 4 and releases of bricks before 6 and 11, blend 12-17, finetune 18-23; joint
0-23 with doublings at 4 and 9 and releases before 12 and 22; finer and copies are joint with finer texels from 12
on, and copies have finer copies from 17 on."""


@pytest.fixture(scope="module", params=["split", "all", "finer", "copies"])
def whole(request, scene, plan_file, tmp_path_factory):
    """Settings, and the checkpoints of every step of an uninterrupted run."""
    joint = request.param in ("finer", "copies")
    settings = {"training": "joint"} if joint else {"rays_per_mpi": request.param}
    settings |= {"shading": "sample" if request.param == "all" else "ray"}
    settings |= {"release_shares": (0.5, 0.9), "release_weight": 0.06}
    if joint:
        plan = tmp_path_factory.mktemp("finer") / "plan.json"
        plan.write_text(
            replace(WindowedPlan.load(plan_file).plans[0], detail=2.0 if request.param == "finer" else 64.0).to_json()
        )
        settings |= {"plan_file": plan, "release_shares": (0.5, 0.7, 0.9), "decay_from": 0.8}
    config = trainer_config(scene, plan_file, tmp_path_factory.mktemp("whole"), STEPS, **settings)
    trainer = ready(config)
    trainer.train()
    return settings, trainer.checkpoint_dir


@pytest.fixture
def resumed(whole, scene, plan_file, tmp_path):
    def run(step, **changes):
        """Resumes the run from the checkpoint of a step and returns the new checkpoint folder."""
        config = trainer_config(scene, plan_file, tmp_path / f"from{step}", STEPS, **whole[0])
        trainer = ready(config, load_dir=whole[1], load_step=step, **changes)
        torch.rand(5)  # a resumed process has drawn other numbers before
        trainer.train()
        return trainer.checkpoint_dir

    return run


STOPPED = {"split": (3, 5, 11, 12, 17, STEPS - 2), "all": (5, 11, 17), "finer": (3, 8, 11), "copies": (11, 17, 21)}
"""Steps before which tables grow, bricks go, texels become finer or are copied, or a phase begins; and the last."""


@pytest.mark.parametrize(("whole", "step"), [(k, s) for k, steps in STOPPED.items() for s in steps], indirect=["whole"])
def test_a_resumed_run_ends_as_the_uninterrupted_one(whole, resumed, step):
    folder = resumed(step)
    for last in range(max(step + 1, STEPS - 2), STEPS):
        wanted, actual = load(whole[1], last), load(folder, last)
        assert differences(compared(wanted), compared(actual)) == []
    assert sorted(int(p.stem[5:]) for p in folder.iterdir()) == list(range(step + 1, STEPS))
    last, first = (load(folder, s)["optimizers"]["density"]["state"] for s in (STEPS - 1, step + 1))
    assert not last, "after the last step nobody needs moments"
    assert step + 1 == STEPS - 1 or set(first[0]) == {"step", "moments"}


def test_bricks_were_given_up_on_the_way_and_checkpoints_hold_the_others_alone(whole):
    """Between step 4, when resolution stops growing, and the end of the first phase."""
    if "plan_file" in whole[0]:
        pytest.skip("texels become finer on the way")
    states = [load(whole[1], step) for step in range(4, 14)]
    rows = [len(state["pipeline"]["_model.field.density"]) for state in states]
    assert rows == sorted(rows, reverse=True) and rows[-1] < rows[0]
    for state, count in zip(states, rows, strict=True):
        field = {k.removeprefix("_model.field."): v for k, v in state["pipeline"].items()}
        assert count == 64 * ((field["tiles"] > 0).sum() + 1)
        assert {len(field[k]) for k in ("features", "reliability", "touched")} == {count}
        moments = state["optimizers"]["features"]["state"]
        assert len(moments[0]["moments"]) == count
    counts = [state["optimizers"]["features"]["state"][0]["step"] for state in states]
    assert counts == sorted(counts) and counts[0] == 1, "moments go on where bricks go"


def test_texels_become_finer_or_get_copies_where_the_plan_allows_it(whole):
    states = [load(whole[1], step)["pipeline"] for step in range(1, STEPS)]
    factors, copied = ([float(state[f"_model.field.{n}"]) for state in states] for n in ("texel_factor", "copied"))
    assert factors == sorted(factors) and factors[10] == 1 and not any(copied[:16])
    detail = WindowedPlan.load(whole[0]["plan_file"]).plans[0].detail if "plan_file" in whole[0] else 1.0
    assert 1.25 <= factors[11] <= detail if detail > 1 else factors[-1] == 1
    assert copied[16:] == [float(detail > 2)] * (STEPS - 17)


def test_frozen_parameters_stay_bit_identical(whole):
    """Steps 12 to 17 are the blend phase: only reliability learns. Joint training never learns it."""
    before, first, last, after = (load(whole[1], step)["pipeline"] for step in (11, 12, 17, 18))

    def changed(a, b):
        return {k.removeprefix("_model.field.") for k in a if not torch.equal(a[k], b[k])}

    assert not before["_model.field.reliability"].any()
    if "training" in whole[0]:
        assert not load(whole[1], STEPS - 1)["pipeline"]["_model.field.reliability"].any()
        assert changed(first, last) >= {"density", "features", "networks.weights"}
    else:
        assert changed(first, last) == {"reliability"}
        assert changed(last, after) >= {"density", "features", "reliability", "networks.weights"}


def test_checkpoints_load_as_plain_data_and_hold_plan_schedule_and_resolution(whole):
    state = load(whole[1], 1)
    assert state["step"] == 1 and float(state["pipeline"]["_model.field.texel_factor"]) < 1
    assert {"_model.field.plan_bytes", "_model.progress.schedule_bytes"} <= set(state["pipeline"])
    rates = [g["lr"] for o in state["optimizers"].values() for g in o["param_groups"]]
    assert all(type(r) is float for r in rates)
    assert (whole[1].parent / "plan.json").is_file()


@pytest.mark.parametrize(("whole", "step"), [("split", 14)], indirect=["whole"])
@pytest.mark.parametrize(("loads", "training"), [(False, "two-phase"), (True, "joint")])
def test_rates_and_reliability_follow_the_checkpoint(whole, scene, plan_file, tmp_path, step, loads, training):
    config = trainer_config(scene, plan_file, tmp_path, STEPS, **whole[0])
    config.load_scheduler, config.pipeline.model.schedule.training = loads, training
    trainer = ready(config, load_dir=whole[1], load_step=step)
    trainer.train()
    states = (load(folder, STEPS - 2) for folder in (whole[1], trainer.checkpoint_dir))
    assert differences(*({k: state[k] for k in ("pipeline", "optimizers")} for state in states)) == []


# Interruptions -------------------------------------------------------------------------------------------------------


class Interrupted(Exception):
    pass


def call_before(trainer, step, function):
    """Calls a function before a step of the trainer."""

    def check(step_now):
        if step_now == step:
            function()

    def run(step):
        check(step)

    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], run))


@pytest.mark.parametrize("step", [12])
def test_a_run_that_died_goes_on_from_its_last_checkpoint(whole, scene, plan_file, tmp_path, step):
    config = trainer_config(scene, plan_file, tmp_path / "a", STEPS, **whole[0])
    config.save_only_latest_checkpoint = True
    trainer = ready(config)

    def die():
        raise Interrupted

    call_before(trainer, step, die)
    with pytest.raises(Interrupted):
        trainer.train()
    assert [p.name for p in trainer.checkpoint_dir.iterdir()] == [f"step-{step - 1:09d}.ckpt"]
    again = ready(trainer_config(scene, plan_file, tmp_path / "b", STEPS, **whole[0]), load_dir=trainer.checkpoint_dir)
    again.train()
    actual = load(again.checkpoint_dir, STEPS - 1)
    assert differences(compared(load(whole[1], STEPS - 1)), compared(actual)) == []


@pytest.mark.parametrize("step", [12])
def test_a_run_that_was_asked_to_stop_saves_the_step_it_did_last(whole, scene, plan_file, tmp_path, step):
    """Stopping from the viewer: the step after the request does not run, so it must not be counted."""
    config = trainer_config(scene, plan_file, tmp_path / "a", STEPS, **whole[0])
    config.steps_per_save = 1000
    trainer = ready(config)

    def stop():
        trainer.stop_training = True

    call_before(trainer, step, stop)
    trainer.train()
    steps = [int(p.stem[5:]) for p in trainer.checkpoint_dir.iterdir()]
    assert steps[-1:] == [step]
    assert differences(compared(load(whole[1], step)), compared(load(trainer.checkpoint_dir, step))) == []
    again = ready(trainer_config(scene, plan_file, tmp_path / "b", STEPS, **whole[0]), load_dir=trainer.checkpoint_dir)
    again.train()
    actual = load(again.checkpoint_dir, STEPS - 1)
    assert differences(compared(load(whole[1], STEPS - 1)), compared(actual)) == []


def test_a_full_disk_leaves_the_old_checkpoint_and_nothing_else(scene, plan_file, tmp_path, monkeypatch):
    config = trainer_config(scene, plan_file, tmp_path, STEPS)
    config.save_only_latest_checkpoint = True
    trainer = ready(config)
    save, calls = torch.save, []

    def full(state, path, *args, **kwargs):
        calls.append(path)
        save(state, path, *args, **kwargs)
        if len(calls) > 3:
            with open(path, "r+b") as file:
                file.truncate(file.seek(0, 2) // 2)
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space"):
        trainer.train()
    folder = trainer.checkpoint_dir
    assert [p.name for p in folder.iterdir()] == ["step-000000003.ckpt"] and load(folder, 3)["step"] == 3
    assert not [p for p in folder.parent.iterdir() if "ckpt" in p.name], "the unfinished file is gone"
    monkeypatch.undo()
    again = ready(trainer_config(scene, plan_file, tmp_path / "b", STEPS), load_dir=folder)
    assert again._start_step == 4


# What does not fit ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{"num_mpis": 3, "with_cube": True}, {"planes": 13, "with_cube": True}])
def test_a_checkpoint_of_another_plan_is_refused_in_one_sentence(whole, scene, tmp_path, settings):
    plan = write_plan(scene, tmp_path / "plan.json", **settings)
    config = trainer_config(scene, plan, tmp_path / "out", STEPS, **(whole[0] | {"plan_file": plan}))
    with pytest.raises(ValueError, match="another scene plan") as error:
        ready(config, load_dir=whole[1], load_step=5)
    assert "\n" not in str(error.value) and str(whole[1]) in str(error.value)


def test_a_checkpoint_of_another_method_is_refused(whole, scene, plan_file, tmp_path):
    state = load(whole[1], 5)
    del state["pipeline"]["_model.field.plan_bytes"]
    folder = tmp_path / "models"
    folder.mkdir()
    torch.save(state, folder / "step-000000005.ckpt")
    with pytest.raises(ValueError, match="not written by this method"):
        ready(trainer_config(scene, plan_file, tmp_path / "out", STEPS, **whole[0]), load_dir=folder)


def test_a_longer_run_keeps_the_schedule_of_the_checkpoint_in_model_and_learning_rates(
    whole, scene, plan_file, tmp_path
):
    config = trainer_config(scene, plan_file, tmp_path / "out", STEPS + 6, **whole[0])
    trainer = ready(config, load_dir=whole[1], load_step=STEPS - 4)
    schedule = trainer.pipeline.model.progress.schedule
    assert schedule.total_steps == STEPS
    trainer.train()
    assert sorted(int(p.stem[5:]) for p in trainer.checkpoint_dir.iterdir())[-1] == STEPS + 5
    before, state = (load(trainer.checkpoint_dir, step) for step in (STEPS - 2, STEPS - 1))
    assert differences(compared(load(whole[1], STEPS - 2)), compared(before)) == []
    last = load(whole[1], STEPS - 1)["pipeline"]  # in half precision
    assert last["_model.field.features"].dtype == torch.float16
    assert differences(last, in_half_precision(state["pipeline"])) == []
    assert state["optimizers"]["density"]["state"], "this run goes on, and its moments with it"


@pytest.mark.parametrize("steps", [0, 150])
def test_without_a_number_of_steps_they_follow_the_pixels(scene, plan_file, tmp_path, monkeypatch, capsys, steps):
    monkeypatch.setattr("mmpi_ns.placement.defaults.STEPS", 100)
    monkeypatch.setattr("mmpi_ns.placement.defaults.LEAST_STEPS", 100)
    monkeypatch.setattr("mmpi_ns.placement.defaults.FEW", 1.0)
    monkeypatch.setattr("mmpi_ns.placement.defaults.MANY", 1.0)
    config = trainer_config(scene, plan_file, tmp_path, steps=steps)
    trainer = ready(config)
    expected = steps or 300
    assert trainer.pipeline.model.progress.schedule.total_steps == expected == trainer.config.max_num_iterations
    assert trainer.config.steps_per_save == 1, "as given"
    assert ("300 steps for its training pixels" in capsys.readouterr().out) == (steps == 0)
