"""Plan files that cannot be used: ns-train ends with one sentence that names file, MPI and field (docs/errors.md)."""

from __future__ import annotations

import json
import math

import pytest
from forked import run, train

NAN, INF = math.nan, math.inf


@pytest.fixture(scope="module")
def plan_text(whole_scene, tmp_path_factory):
    from training_runs import write_plan

    return write_plan(whole_scene, tmp_path_factory.mktemp("plan") / "plan.json", with_cube=True).read_text()


def mpi(**changes):
    return lambda plan: plan["mpis"][1].update(changes)


def cube(**changes):
    return lambda plan: plan["cube"].update(changes)


def top(**changes):
    return lambda plan: plan.update(changes)


REFUSED = {
    **{
        f"planes {v!r}": (mpi(planes=v), ["'mpi1'", "'planes'"]) for v in ("64", None, 64.5, True, 0, -3, 10_000, 10**9)
    },
    **{f"height {v!r}": (mpi(height=v), ["'mpi1'", "'height'"]) for v in ("64", None, 1, 10**6, [3])},
    **{f"width {v!r}": (mpi(width=v), ["'mpi1'", "'width'"]) for v in (2.5, NAN, 10**400)},
    **{f"near {v!r}": (mpi(near=v), ["'mpi1'", "'near'"]) for v in ("3 m", None, 0, -1, NAN, INF, 1e30)},
    **{f"far {v!r}": (mpi(far=v), ["'mpi1'", "'far'"]) for v in ("3 m", 0, -1, NAN, 1e-9)},
    "origin of two": (mpi(origin=[0, 1]), ["'mpi1'", "'origin'", "3 numbers"]),
    "origin of texts": (mpi(origin=["0", "0", "0"]), ["'mpi1'", "'origin'"]),
    "origin with NaN": (mpi(origin=[0, NAN, 0]), ["'mpi1'", "'origin'", "finite"]),
    "origin is null": (mpi(origin=None), ["'mpi1'", "'origin'"]),
    "axes of texts": (mpi(axes=[["1", "0", "0"]] * 3), ["'mpi1'", "'axes'"]),
    "axes of two rows": (mpi(axes=[[1, 0, 0], [0, 1, 0]]), ["'mpi1'", "'axes'"]),
    "axes is text": (mpi(axes="xyz"), ["'mpi1'", "'axes'"]),
    "axes are not orthonormal": (mpi(axes=[[1, 0, 0], [0, 1, 0], [0, 1, 1]]), ["'mpi1'", "orthonormal"]),
    "axes are left-handed": (mpi(axes=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), ["'mpi1'", "left-handed"]),
    "extent of two": (mpi(extent=[0, 1]), ["'mpi1'", "'extent'"]),
    "extent turned round": (mpi(extent=[1, -1, -1, 1]), ["'mpi1'", "u0 < u1"]),
    "extent is infinite": (mpi(extent=[-INF, INF, -1, 1]), ["'mpi1'", "'extent'"]),
    "name is a number": (mpi(name=3), ["MPI number 2", "name"]),
    "name is empty": (mpi(name=""), ["MPI number 2", "name"]),
    "an unknown field": (mpi(tilt=3), ["'mpi1'", "tilt"]),
    "a field is missing": (lambda p: p["mpis"][1].pop("extent"), ["'mpi1'", "extent"]),
    "an MPI is a number": (lambda p: p["mpis"].append(5), ["MPI number 3"]),
    "no MPI": (top(mpis=[]), ["at least one MPI"]),
    "mpis is no list": (top(mpis={}), ["'mpis' is not a list"]),
    "mpis are missing": (lambda p: p.pop("mpis"), ["lacks ['mpis']"]),
    "cube is text": (top(cube="none"), ["cube", "not a JSON object"]),
    "cube shape of two": (cube(shape=[8, 8]), ["'shape'", "3 numbers"]),
    "cube shape is huge": (cube(shape=[8, 8, 10**7]), ["'shape'"]),
    "cube turned round": (cube(lower=[9, 9, 9]), ["'upper' > 'lower'"]),
    "cube with NaN": (cube(upper=[NAN, 1, 1]), ["'upper'", "cube"]),
    "ray_near is text": (top(ray_near="0"), ["'ray_near'"]),
    "ray_near below 0": (top(ray_near=-1), ["'ray_near'"]),
    "content_near is null": (top(content_near=None), ["'content_near'"]),
    "origin_of_plan is a number": (top(origin_of_plan=1), ["'origin_of_plan'"]),
    "detail below 1": (top(detail=0.5), ["'detail'"]),
    "detail is text": (top(detail="2"), ["'detail'"]),
    "windows is no list": (lambda p: (p.clear(), p.update(windows=3)), ["list 'windows'"]),
    "no windows": (lambda p: (p.clear(), p.update(windows=[])), ["at least one window"]),
    "a window is a number": (lambda p: (p.clear(), p.update(windows=[1])), ["Window 0"]),
}


def test_a_plan_that_is_usable_trains(whole_scene, plan_text, tmp_path):
    path = tmp_path / "plan.json"
    path.write_text(plan_text)
    assert "Training finished" in train(whole_scene, tmp_path, pipeline__model__plan_file=path).shown


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


def test_mmpi_plan_does_not_replace_a_plan_that_was_edited(whole_scene, tmp_path):
    words = ("mmpi-plan", whole_scene, "--output", tmp_path / "o")
    assert "Wrote plan.json" in run(*words).shown
    assert "Wrote plan.json" in run(*words, "--placement.max-mpis", 1).shown  # its own may be replaced
    path = tmp_path / "o" / "plan.json"
    plan = json.loads(path.read_text())
    plan["mpis"][0]["planes"] += 1
    edited = json.dumps(plan)
    path.write_text(edited)
    said = run(*words).sentence
    assert str(path) in said and "was edited" in said and "--output" in said
    assert path.read_text() == edited
