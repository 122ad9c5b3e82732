"""Termination and depth of a ray: the numbers of ``cpp/ends.h``, which C++ and the page's shader read too."""

from __future__ import annotations

import re
from pathlib import Path

TEXT = (Path(__file__).parent / "cpp" / "ends.h").read_text(encoding="utf-8")
"""Source that is valid in C++ and GLSL."""


def numbers_in(text: str, *names: str) -> list[float]:
    """Values of named constants in such a header."""
    numbers = dict(re.findall(r"^const float (\w+) = ([-.\de]+);", text, re.MULTILINE))
    return [float(numbers[name]) for name in names]


OPAQUE, OPAQUE_BAKED, NEGLIGIBLE, NEAREST_ZERO, HALF = numbers_in(
    TEXT, "OPAQUE", "OPAQUE_BAKED", "NEGLIGIBLE", "NEAREST_ZERO", "HALF"
)
