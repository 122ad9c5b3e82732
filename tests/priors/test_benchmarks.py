"""Benchmarks of priors measure a capture."""

from __future__ import annotations

from depths import depths_of
from exposure import calibration

from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset


def test_depths_and_exposures_are_compared_with_the_true_ones(tmp_path):
    folder = tmp_path / "street-none"
    write_dataset(make_scene("street", 0, 8, 160, 48), folder)
    row = depths_of(folder, 1)
    assert row["images"] == 4 and 1e-3 < row["median_error"] < 0.1  # 0 would be that of its own depth images
    row = calibration(folder, 1)
    assert not row["corrected"] and row["median_error"] == 0
