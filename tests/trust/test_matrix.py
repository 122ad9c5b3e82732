"""Ordinary captures through the commands, each to a good end or one sentence (``benchmarks/matrix.py`` runs all)."""

from __future__ import annotations

import itertools
import os

import numpy as np
import pytest
from forked import run, train
from matrix import commands, options
from ordinary_captures import MATRIX, Capture, write_capture

MOST = float(os.environ.get("MMPI_MATRIX", "1.5"))
"""Megapixels of a capture up to which it is run here: these take a few seconds each, the largest of all hours."""


def test_the_matrix_holds_every_pair_of_properties():
    levels = [sorted({str(row[i]) for row in map(list, rows())}) for i in range(6)]
    for i, j in itertools.combinations(range(6), 2):
        pairs = {(str(row[i]), str(row[j])) for row in rows()}
        assert pairs == set(itertools.product(levels[i], levels[j])), (i, j)
    assert [len(level) for level in levels] == [6, 4, 3, 3, 3, 2]


def rows():
    return [tuple(vars(capture).values()) for capture in MATRIX]


@pytest.mark.parametrize("lens", ["none", "opencv", "fisheye"])
def test_pixels_lie_where_the_lens_puts_their_directions(lens):
    """Directions are the inverse of the projection that tracks are made with."""
    capture = Capture(3, 64, "landscape", lens, "tracks", "one")
    local = capture.directions(2, 64, 48) @ capture.pose(2)[:3, :3]
    x, y = capture.distorted(local[..., 0] / -local[..., 2], local[..., 1] / local[..., 2])
    focal = capture.focal(2)
    expected = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    np.testing.assert_allclose([x * focal + 32, y * focal + 24], expected, atol=1e-6)


@pytest.mark.parametrize(
    "capture", [capture for capture in MATRIX if capture.megapixels <= MOST], ids=lambda capture: capture.name
)
def test_a_capture_ends_well_or_in_one_sentence(capture, tmp_path):
    data, output = write_capture(capture, tmp_path / "data"), tmp_path / "output"
    how = {name.replace(".", "__"): value for name, value in options(capture).items()}
    trained = train(data, output, experiment_name="matrix", **how)
    if trained.status:
        assert trained.sentence
        return
    assert trained.shown
    for command in list(commands(capture, data, output).values())[1:]:
        assert run(*command).shown
    assert (output / "site/index.html").is_file()
