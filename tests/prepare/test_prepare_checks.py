"""Warnings of mmpi-prepare that take a whole scene: a focal length that does not fit."""

from __future__ import annotations

import corridor

from mmpi_prepare.pipeline import prepare
from mmpi_prepare.settings import Settings


def report_of(frames, scene, **options):
    prepare(Settings(frames, scene, threads=1, **options))
    return (scene / "report.md").read_text()


def test_still_corridor_raises_no_warning_and_a_wrong_focal_length_does(tmp_path):
    corridor.write_images(tmp_path / "frames", 9, bend=0.05)  # straight ahead, any focal length would do
    assert "None." in report_of(tmp_path / "frames", tmp_path / "right", focal=corridor.FOCAL)
    report = report_of(tmp_path / "frames", tmp_path / "wrong", focal=1.6 * corridor.FOCAL, allow_partial=True)
    assert "does not fit" in report
