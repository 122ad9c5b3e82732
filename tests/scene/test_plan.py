"""Scene plans: what can be read, what is refused and how that is said (placement/plan.py)."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from hand_made import make_mpi

from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan


def refused(**changes):
    """The message with which a plan is refused whose only MPI, called 'kerb', has these fields."""
    with pytest.raises(ValueError) as error:
        ScenePlan((replace(make_mpi("kerb"), **changes),), None, 0.1, 1.0)
    return str(error.value)


def refused_scene(plan, **changes):
    with pytest.raises(ValueError) as error:
        replace(plan, **changes)
    return str(error.value)


def is_one_sentence(message):
    return message.endswith(".") and ". " not in message and "\n" not in message and message[0].isupper()


def test_plan_survives_json(plan):
    assert ScenePlan.from_json(plan.to_json()) == plan
    without_cube = replace(plan, cube=None, origin_of_plan="greedy")
    assert ScenePlan.from_json(without_cube.to_json()) == without_cube
    assert hash(ScenePlan.from_json(plan.to_json())) == hash(plan)


def test_far_end_is_a_number_or_null_in_json_and_may_be_left_out():
    plan = ScenePlan((make_mpi(), make_mpi("kerb", far=0.1 + 7.2)), None, 0.1, 1.0)

    def strict(constant):
        raise AssertionError(f"{constant} is no standard JSON")

    data = json.loads(plan.to_json(), parse_constant=strict)
    assert [m["far"] for m in data["mpis"]] == [None, 0.1 + 7.2]
    assert ScenePlan.from_json(plan.to_json()) == plan
    del data["mpis"][0]["far"], data["mpis"][1]["far"]
    assert [m.far for m in ScenePlan.from_json(json.dumps(data)).mpis] == [math.inf, math.inf]


def test_heads_are_the_mpis_and_then_the_cube(plan):
    assert plan.names == ("front", "left", "cube") and plan.num_heads == 3
    assert replace(plan, cube=None).names == ("front", "left")
    assert plan.texels == 2 * 9 * 5 * 7 + 7 * 5 * 5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"near": 0.0}, "near"),
        ({"near": math.nan}, "finite"),
        ({"origin": (0.0, math.inf, 0.0)}, "finite"),
        ({"extent": (1.0, -1.0, -1.0, 1.0)}, "extent"),
        ({"axes": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 2.0))}, "axes"),
        ({"axes": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))}, "axes"),  # left-handed
        ({"planes": 1}, "planes"),
        ({"height": 1}, "height"),
        ({"far": 1.0}, "far"),
        ({"far": math.nan}, "far"),
    ],
)
def test_unusable_mpis_are_refused_by_name_and_field(changes, words):
    message = refused(**changes)
    assert "'kerb'" in message and words in message
    assert is_one_sentence(message)


def test_scene_plans_without_mpis_or_with_impossible_distances_are_refused(plan):
    messages = [
        (refused_scene(plan, mpis=()), "mpis"),
        (refused_scene(plan, ray_near=-0.1), "ray_near"),
        (refused_scene(plan, content_near=-1.0), "content_near"),
        (refused_scene(plan, cube=replace(plan.cube, upper=plan.cube.lower)), "cube"),
        (refused_scene(plan, cube=replace(plan.cube, shape=(7, 1, 5))), "cube"),
    ]
    for message, word in messages:
        assert word in message and is_one_sentence(message)


@pytest.mark.parametrize(
    ("field", "value"), [("extent", [0.0, 1.0]), ("origin", [0.0, 1.0]), ("near", "3 m"), ("far", "3 m")]
)
def test_fields_of_the_wrong_form_name_the_mpi(plan, field, value):
    data = json.loads(plan.to_json())
    data["mpis"][1][field] = value
    with pytest.raises(ValueError, match=rf"left.*{field}|{field}.*left"):
        ScenePlan.from_json(json.dumps(data))


def test_scaled_plan_has_that_share_of_the_texels_and_the_same_frames():
    mpi = MPIPlan("a", (0.0,) * 3, make_mpi().axes, 1.0, (-1.0, 1.0, -0.5, 0.5), planes=32, height=96, width=192)
    plan = ScenePlan((mpi,), CubePlan((0.0,) * 3, (1.0, 2.0, 3.0), (160, 80, 40)), 0.1, 1.0)
    quarter = plan.scaled(0.25)
    assert quarter.mpis[0] == replace(mpi, height=48, width=96)
    assert plan.scaled(1 / 16).mpis[0] == replace(mpi, height=24, width=48)
    assert plan.scaled(1 / 8).cube == replace(plan.cube, shape=(80, 40, 20))
    assert quarter.texels == pytest.approx(plan.texels / 4, rel=0.02)
    assert plan.scaled(1) is plan and (quarter.ray_near, quarter.content_near) == (0.1, 1.0)
