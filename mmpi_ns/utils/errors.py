"""Messages to the user: plain lines, progress bars, and errors of one sentence without a traceback."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


class InputError(ValueError):
    """Unusable input. The message is one sentence: what is wrong, where, and what to do."""


class WriteError(InputError, OSError):
    """Failure to write a file or folder; one sentence as well."""


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
