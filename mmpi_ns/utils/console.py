"""What is said to the user."""

from __future__ import annotations

from nerfstudio.utils.rich_utils import CONSOLE


def say(text: str) -> None:
    """Prints text as it is: no line is broken, so that paths and commands can be copied, and nothing is coloured."""
    CONSOLE.print(text, soft_wrap=True, highlight=False, markup=False)


def duration(seconds: float) -> str:
    """Seconds in words: 45 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
