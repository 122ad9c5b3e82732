"""When a ray ends and where its depth lies: the numbers of ``cpp/ends.h``, which C++ and the page's shader read too."""

from __future__ import annotations

import re
from pathlib import Path

TEXT = (Path(__file__).parent / "cpp" / "ends.h").read_text(encoding="utf-8")
"""Lines that both C++ and GLSL understand."""


def numbers_in(text: str) -> dict[str, float]:
    """Numbers of such a header by their names."""
    return {name: float(number) for name, number in re.findall(r"^const float (\w+) = ([-.\de]+);", text, re.MULTILINE)}


_NUMBERS = numbers_in(TEXT)
OPAQUE = _NUMBERS["OPAQUE"]
OPAQUE_BAKED = _NUMBERS["OPAQUE_BAKED"]
NEGLIGIBLE = _NUMBERS["NEGLIGIBLE"]
NEAREST_ZERO = _NUMBERS["NEAREST_ZERO"]
HALF = _NUMBERS["HALF"]
