"""The benchmark of exposures measures a capture."""

from __future__ import annotations

from exposure import calibration

from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset


def test_exposures_are_compared_with_the_true_ones(tmp_path):
    folder = tmp_path / "street-none"
    write_dataset(make_scene("street", 0, 8, 160, 48), folder)
    row = calibration(folder, 1)
    assert not row["corrected"] and row["median_error"] == 0
