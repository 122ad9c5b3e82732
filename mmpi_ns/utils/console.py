"""What nerfstudio's commands print: what a user can do nothing about is left out."""

from __future__ import annotations

import os
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from mmpi_ns.utils.errors import TRACEBACK

NOT_FOR_USERS = (
    "Mixed precision is disabled",
    "No Nerfstudio checkpoint to load",
    "logging events to:",
    "[bold yellow]logging events to:",
    "[NOTE] Not running eval iterations",
)
"""How such lines begin. All of ``CONSOLE.log`` is of that kind, and has the line of nerfstudio's code beside it."""
_print = CONSOLE.print


def keep_quiet() -> None:
    """From now on nerfstudio's notices are not shown in this process; with ``MMPI_TRACEBACK=1`` they are."""
    if os.environ.get(TRACEBACK) != "1":
        CONSOLE.log = lambda *_, **__: None  # type: ignore[method-assign]
        CONSOLE.print = _print_for_users  # type: ignore[method-assign]


def _print_for_users(*objects: Any, **how: Any) -> None:
    if not (objects and isinstance(objects[0], str) and objects[0].startswith(NOT_FOR_USERS)):
        _print(*objects, **how)


def say(text: str) -> None:
    """Prints text as it is: no line is broken, so that paths and commands can be copied, and nothing is coloured."""
    CONSOLE.print(text, soft_wrap=True, highlight=False, markup=False)


def duration(seconds: float) -> str:
    """Seconds in words: 45 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
