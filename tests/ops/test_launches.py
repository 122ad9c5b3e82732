"""Few operations a step: what torch does around each takes longer than many of them."""

from __future__ import annotations

import pytest
from compiled import compiled  # noqa: F401
from interpreted_graphs import STEPS, Tape, prepared


@pytest.mark.parametrize(
    ("training", "shading", "most"),
    [("joint", "ray", {12: 250}), ("two-phase", "sample", {4: 335, 10: 335, 13: 430})],
    ids=["joint", "individual, blend and finetune"],
)
def test_a_step_on_a_cpu_has_few_operations(scene, plan_file, tmp_path, training, shading, most):
    """In each phase, with total variation where densities train; steps whose rays are drawn are not among them."""
    run, graphs, _ = prepared(scene, plan_file, tmp_path, training, shading)
    graphs.is_off, graphs.manager._is_replayed = True, False
    actual = {}
    for step in range(STEPS):
        with Tape() as tape:
            run(step)
        actual[step] = len(tape.launches)
    assert all(actual[step] <= number for step, number in most.items()), str(actual)
