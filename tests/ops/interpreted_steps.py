"""How often a training step waits for the device, on the GPU's path, and what it compiles: run like
interpreted_march.py."""

from __future__ import annotations

from interpreting import interpreted  # noqa: F401
from waits import TRAININGS, counted_on_a_cpu, variants_noted, waits_of_phases

from mmpi_ns.ops import dispatch


@TRAININGS
def test_a_step_waits_twice_at_most_and_kernels_are_not_compiled_for_sizes(
    scene, plan_file, tmp_path, monkeypatch, training, phases
):
    assert dispatch.fault("Triton") is None
    with variants_noted(monkeypatch) as variants:
        found = waits_of_phases(scene, plan_file, tmp_path, training, "cpu", lambda: counted_on_a_cpu(monkeypatch))
    assert list(found) == phases
    for phase, waits in found.items():
        print(phase, dict(waits.found), waits.launches, "launches")
        assert 1 <= sum(waits.found.values()) <= 2, (phase, waits.found)
        print(phase, waits.peak, "bytes of arrays of", waits.reserved)
        assert 0.05 * waits.reserved < waits.peak <= waits.reserved
    print(training, {name: len(kinds) for name, kinds in sorted(variants.items())})
    many = {name: kinds for name, kinds in variants.items() if len(kinds) > 4}
    assert not many, many  # one or nine channels, four or eight texels
