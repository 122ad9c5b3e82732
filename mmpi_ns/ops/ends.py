"""When a ray ends and where its depth lies: the numbers of ``cpp/ends.h``, which C++ and the page's shader read too."""

from __future__ import annotations

import re
from pathlib import Path

TEXT = (Path(__file__).parent / "cpp" / "ends.h").read_text(encoding="utf-8")
"""Lines that both C++ and GLSL understand."""
_NUMBERS = {name: float(number) for name, number in re.findall(r"^const float (\w+) = ([-.\de]+);", TEXT, re.MULTILINE)}

OPAQUE = _NUMBERS["OPAQUE"]
OPAQUE_BAKED = _NUMBERS["OPAQUE_BAKED"]
NEGLIGIBLE = _NUMBERS["NEGLIGIBLE"]
NEAREST_ZERO = _NUMBERS["NEAREST_ZERO"]
HALF = _NUMBERS["HALF"]
