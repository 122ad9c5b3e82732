"""Hard inputs come out within the roundings that float32 allows (docs/stability.md)."""

from __future__ import annotations

import pytest
from stability import blending, geometry, merging
from stability.cases import PRECISIONS

EVERY = [case for group in (geometry, blending, merging) for case in group.cases()]


@pytest.mark.parametrize("precision", PRECISIONS, ids=lambda p: p.name)
@pytest.mark.parametrize("case", EVERY, ids=lambda c: f"{c.group}: {c.inputs}")
def test_every_case_holds(case, precision):
    outcome = case.measure(precision)
    assert outcome.holds, f"{case.expectation}: {outcome}"
