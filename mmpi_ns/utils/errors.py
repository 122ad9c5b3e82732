"""Messages to the user: plain lines, and errors of one sentence without a traceback."""

from __future__ import annotations

import shlex
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE


class InputError(ValueError):
    """Unusable input. The message is one sentence: what is wrong, where, and what to do."""


class WriteError(InputError, OSError):
    """Failure to write a file or folder; one sentence as well."""


def brief(error: BaseException) -> str:
    """First sentence of an error, to quote in brackets in a sentence of ours."""
    return str(error).strip().split("\n")[0].split(". ")[0].rstrip(" .")


def quoted(path: Path) -> str:
    """A path as a shell takes it, for a command to be copied."""
    return shlex.quote(str(path))


def say(text: str) -> None:
    """Prints text as it is: no line is broken, so that paths and commands can be copied, and nothing is coloured."""
    CONSOLE.print(text, soft_wrap=True, highlight=False, markup=False)


def duration(seconds: float) -> str:
    """Seconds in words: 45 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
