"""Borders that MPIs are widened to, and the table of a plan, against figures worked out by hand or by slow loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from seen_points import FX, FY, HEIGHT, WIDTH, mpi, observed

from mmpi_ns.placement.observations import find_visible_points
from mmpi_ns.placement.rule import widened


def test_a_border_goes_to_the_mpi_that_must_grow_least_and_texels_keep_their_size_both_ways():
    observations = observed([[0.0, 0, 0]], [[0.0, 0, -10]] * 30, np.zeros(30))
    whole = (-WIDTH / 2 / FX, WIDTH / 2 / FX, -HEIGHT / 2 / FY, HEIGHT / 2 / FY)
    close, narrow = mpi(extent=whole), mpi(extent=tuple(0.7 * x for x in whole))
    got = widened([narrow, close], observations, find_visible_points(observations))
    assert got[0] == narrow
    assert got[1].extent == pytest.approx([1.1 * x for x in whole])
    assert (got[1].height - 1) / (close.height - 1) == pytest.approx(1.1, rel=0.01)
    far = replace(close, near=11.0)  # begins behind the content, so it holds none of it
    got = widened([narrow, far], observations, find_visible_points(observations))
    assert got[1] == far and got[0].extent == pytest.approx([1.1 * x for x in whole])
