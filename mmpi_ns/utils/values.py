"""Checks of single values that a user wrote, in a file or as an option."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from mmpi_ns.utils.errors import InputError

LARGEST = sys.float_info.max
"""Largest floating-point number; whole numbers in a file may be larger."""


@dataclass(frozen=True)
class Number:
    """Range of valid numbers: finite, from ``low`` to ``high``."""

    low: float = -math.inf
    high: float = math.inf
    whole: bool = False
    above: bool = False
    """Whether ``low`` itself is excluded."""

    def holds(self, value: Any) -> bool:
        """Whether a value is such a number; truth values and text are not."""
        if not isinstance(value, Integral if self.whole else Real) or isinstance(value, bool):
            return False
        number: Any = value
        return self.low <= number <= self.high and not (self.above and number == self.low) and abs(number) <= LARGEST

    def __str__(self) -> str:
        kind, bounded = "a whole number" if self.whole else "a finite number", self.high < math.inf
        if self.low == -math.inf:
            return kind
        if self.above:
            return f"{kind} above {self.low:g}" + (f" and at most {self.high:g}" if bounded else "")
        return f"{kind} from {self.low:g} to {self.high:g}" if bounded else f"{kind} of at least {self.low:g}"


def check_number(what: str, value: Any, number: Number) -> None:
    """Raises InputError where ``value`` is no such number; ``what`` begins the sentence."""
    if not number.holds(value):
        raise InputError(f"{what} must be {number}, not {as_text(value)}.")


def check_row(what: str, row: Any, count: int, number: Number) -> None:
    """Raises InputError where ``row`` does not hold ``count`` such numbers."""
    if not isinstance(row, (list, tuple)) or len(row) != count or not all(number.holds(x) for x in row):
        raise InputError(f"{what} must be {count} numbers, each {number}, not {as_text(row)}.")


def check_options(settings: Any, ranges: Mapping[str, Number], prefix: str) -> None:
    """Raises InputError naming the option of ``settings`` that has no value within its range.

    Args:
        settings: an object with these fields; a tuple's elements are checked one by one.
        ranges: by the fields' names.
        prefix: of the options on the command line, "--placement." for example.
    """
    for name, number in ranges.items():
        value = getattr(settings, name)
        for element in value if isinstance(value, tuple) else (value,):
            check_number(prefix + name.replace("_", "-"), element, number)


def check_text(what: str, value: Any) -> None:
    """Raises InputError where ``value`` is no text, or empty."""
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{what} must be text, not {as_text(value)}.")


def cut(text: str, most: int = 120) -> str:
    """A name to quote in a sentence, in one line of at most ``most`` characters."""
    text = " ".join(text.split())
    return text if len(text) <= most else text[: most - 3] + "..."


def as_text(value: Any, most: int = 60) -> str:
    """A value to quote in a sentence."""
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**most else "a longer number"
    return cut(text, most).replace(". ", " ")
