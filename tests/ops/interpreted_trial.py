"""The trials of large shapes by Triton's interpreter: run like interpreted_march.py."""

from __future__ import annotations

import pytest
from interpreting import interpreted  # noqa: F401

from mmpi_ns.ops import trial
from mmpi_ns.ops.layout import Shapes


@pytest.mark.parametrize("name", trial.CASES)
def test_kernels_pass_their_trial_with_the_shapes_of_large_plans(name):
    """Many heads, eight channels; trials of two-phase training and without it."""
    rest = name != "show_rays"  # which takes what the march keeps
    trial.run(name, "cpu", Shapes((9,), rest, rest))
    if rest:
        trial.run(name, "cpu", Shapes((33,), cube=False, blends=False))
