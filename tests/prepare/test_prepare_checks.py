"""Warnings of mmpi-prepare that take a whole scene: something that moves, a focal length that does not fit."""

from __future__ import annotations

import corridor
import numpy as np
from PIL import Image

from mmpi_ns.prepare.pipeline import prepare
from mmpi_ns.prepare.settings import Settings


def report_of(frames, scene, **options):
    prepare(Settings(frames, scene, threads=1, **options))
    return (scene / "report.md").read_text()


def test_something_that_moves_across_the_view_is_warned_of(tmp_path):
    corridor.write_images(tmp_path / "frames", 8)
    patch = np.asarray(corridor.picture(corridor.poses(1)[0], seed=9))[40:110, 60:150]
    for i, file in enumerate(sorted((tmp_path / "frames").iterdir())):
        image = np.asarray(Image.open(file)).copy()
        image[60 - 6 * i : 130 - 6 * i, 20:110] = patch  # upwards: across the lines that forward motion draws
        Image.fromarray(image).save(file)
    report = report_of(tmp_path / "frames", tmp_path / "scene", focal=corridor.FOCAL)
    assert "moving?" in report


def test_still_corridor_raises_no_warning_and_a_wrong_focal_length_does(tmp_path):
    corridor.write_images(tmp_path / "frames", 9, bend=0.05)  # straight ahead, any focal length would do
    assert "None." in report_of(tmp_path / "frames", tmp_path / "right", focal=corridor.FOCAL)
    report = report_of(tmp_path / "frames", tmp_path / "wrong", focal=1.6 * corridor.FOCAL, allow_partial=True)
    assert "does not fit" in report
