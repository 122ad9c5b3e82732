"""In which order tables grow and bricks are released (training.run.py)."""

from __future__ import annotations

from types import SimpleNamespace

from training_runs import schedule_of

from mmpi_ns.training.run import FORMING, prepare_storage


def test_what_is_released_at_a_growth_is_released_before_it_and_by_a_lower_weight():
    calls = []
    field = SimpleNamespace(
        factor=0.5,
        grow=lambda factor: calls.append(("grow", factor)),
        release_unused=lambda least: calls.append(("release", least)),
        look_afresh=lambda: calls.append(("look afresh",)),
    )
    schedule = schedule_of("joint", 100, growth_shares=(0.5,), release_shares=(0.5, 0.75))
    prepare_storage(field, schedule, 50, 0.01, {})
    assert calls == [("release", FORMING * 0.01), ("grow", 1.0)]
    field.factor = 1.0
    for step in (51, 74, 75, 76):
        prepare_storage(field, schedule, step, 0.01, {})
    assert calls[2:] == [("release", 0.01)]
