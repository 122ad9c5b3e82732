"""Plan files that cannot be used: ns-train ends with one sentence that names file, MPI and field."""

from __future__ import annotations

import json

import pytest
from forked import run, train


@pytest.fixture(scope="module")
def plan_text(whole_scene, tmp_path_factory):
    from training_runs import write_plan

    return write_plan(whole_scene, tmp_path_factory.mktemp("plan") / "plan.json", with_cube=True).read_text()


def test_a_plan_that_is_usable_trains(whole_scene, plan_text, tmp_path):
    path = tmp_path / "plan.json"
    path.write_text(plan_text)
    assert "Training finished" in train(whole_scene, tmp_path, pipeline__model__plan_file=path).printed


def test_a_plan_that_no_camera_sees_is_refused(whole_scene, plan_text, tmp_path):
    plan = json.loads(plan_text) | {"cube": None}
    for mpi in plan["mpis"]:
        mpi.update(origin=[0, 0, 1e6], far=1e3)
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(plan))
    assert "No training image sees" in train(whole_scene, tmp_path, pipeline__model__plan_file=path).sentence


@pytest.mark.parametrize("side", [2000, 16384])
def test_a_plan_that_needs_more_memory_than_there_is_is_refused_before_anything_is_allocated(
    whole_scene, plan_text, tmp_path, side
):
    plan = json.loads(plan_text)
    plan["mpis"][1].update(planes=4000, height=side, width=side)
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(plan))
    ended = train(whole_scene, tmp_path, memory=2 << 30, pipeline__model__plan_file=path)
    assert "GiB" in ended.sentence and "fewer texels" in ended.sentence


def test_a_plan_that_was_edited_is_kept_beside_the_new_one(whole_scene, tmp_path):
    words = ("mmpi-plan", whole_scene, "--output", tmp_path / "o")
    assert "Wrote plan.json" in run(*words).printed
    path = tmp_path / "o" / "plan.json"
    first, plan = path.read_text(), json.loads(path.read_text())
    plan["mpis"][0]["planes"] += 1
    path.write_text(json.dumps(plan))
    assert "Wrote plan.json" in run(*words).printed and path.read_text() == first
    assert json.loads((tmp_path / "o" / "plan.json.before").read_text()) == plan
