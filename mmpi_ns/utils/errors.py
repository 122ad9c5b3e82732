"""Messages to the user: plain lines, progress bars, and errors of one sentence without a traceback."""

from __future__ import annotations

import errno
import os
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a full disk, or of a user's share of it."""
NO_MEMORY = "can't allocate memory|out of memory|Insufficient memory|can't start new thread|bad_alloc"
"""Messages of torch, CUDA, OpenCV, Python and C++ for lack of memory or threads."""


class InputError(ValueError):
    """Unusable input. The message is one sentence: what is wrong, where, and what to do."""


class WriteError(InputError, OSError):
    """Failure to write a file or folder; one sentence as well."""


def used_up(error: BaseException) -> str | None:
    """A sentence for an error of a full disk or exhausted memory, of the computer or a GPU; None for any other error,
    and if it is a sentence already."""
    if isinstance(error, InputError):
        return None
    number = getattr(error, "errno", None)
    if number in FULL or os.strerror(errno.ENOSPC) in str(error):  # as ffmpeg says it
        name = getattr(error, "filename", None)
        what = f"{name} could not be written" if name else "A file could not be written"
        why = os.strerror(number or errno.ENOSPC)
        return f"{what} ({why}): finished files are untouched, so make room and start again."
    if isinstance(error, MemoryError) or number == errno.ENOMEM or re.search(NO_MEMORY, str(error)):
        what = brief(error) or type(error).__name__
        return (
            f"Memory is used up ({what}): finished files are untouched, so end other programs or give less, and "
            "start again."
        )
    return None


def brief(error: BaseException) -> str:
    """First sentence of an error, to quote in brackets."""
    return str(error).strip().split("\n")[0].split(". ")[0].rstrip(" .")


def quoted(path: Path) -> str:
    """A path quoted for the shell."""
    return shlex.quote(str(path))


def looked_at(path: Path) -> str:
    """A missing path, for a message: a relative one with the folder that it is relative to."""
    return str(path) if path.is_absolute() else f"{path} in {Path.cwd()}, from where the path is seen"


def log(text: str, style: str = "") -> None:
    """Prints text without markup or line breaks, so that brackets are kept and commands can be copied."""
    CONSOLE.print(text, style=style, soft_wrap=True, highlight=False, markup=False)


@contextmanager
def progress(what: str, total: int | None) -> Iterator[Callable[..., None]]:
    """A progress bar; yields a function that advances it by a count, from ``start`` where it begins anew."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=CONSOLE) as bar:
        task = bar.add_task(what, total=total)

        def advance(count: int = 1, start: float | None = None) -> None:
            done = count + (bar.tasks[task].completed if start is None else start)
            bar.update(task, completed=done if total is None else min(done, total))

        yield advance


def duration(seconds: float) -> str:
    """Seconds in words: 45 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
