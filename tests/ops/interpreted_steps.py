"""How often a training step waits for the device, on the GPU's path: run like interpreted_march.py."""

from __future__ import annotations

from interpreting import interpreted  # noqa: F401
from waits import TRAININGS, counted_on_a_cpu, waits_of_phases


@TRAININGS
def test_a_step_waits_for_the_device_twice_at_most(scene, plan_file, tmp_path, monkeypatch, training, phases):
    found = waits_of_phases(scene, plan_file, tmp_path, training, "cpu", lambda: counted_on_a_cpu(monkeypatch))
    assert list(found) == phases
    for phase, waits in found.items():
        print(phase, sum(waits.found.values()), "waits,", waits.launches, "launches")
        assert 1 <= sum(waits.found.values()) <= 2, (phase, waits.found)
