"""Everything that this package changes in its host (nerfstudio, Python, glibc), with the reason and the undo of each.

Nothing happens at import, nor in a program that makes a model, a pipeline or a trainer itself. ``PATCHES`` last for a
process and are made in nerfstudio's commands and ours alone (``enter_command``); ``undo`` takes them back. What is
changed for a block is a context manager below. No other module of the method assigns to what it imports
(``tests/utils/test_host.py``).
"""

from __future__ import annotations

import ctypes
import errno
import os
import signal
import stat
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from itertools import takewhile
from pathlib import Path
from threading import current_thread, main_thread
from types import ModuleType, TracebackType
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from mmpi_ns.utils.errors import InputError, used_up

TRACEBACK = "MMPI_TRACEBACK"
"""Set to 1 in the environment it shows the traceback of every error, and nerfstudio's notices."""
NOTICES = (
    "Mixed precision is disabled",
    "No Nerfstudio checkpoint to load",
    "logging events to:",
    "[bold yellow]logging events to:",
    "[NOTE] Not running eval iterations",
)
"""Beginnings of nerfstudio's lines that a user can do nothing about."""
WARNINGS = (
    "Using a non-tuple sequence for multidimensional indexing",
    "`torch.cuda.amp",
    "Detected call of `lr_scheduler.step\\(\\)` before `optimizer.step\\(\\)`",  # parameters that are frozen at first
    "Sparse invariant checks are implicitly disabled",
    "You are using `torch.load` with `weights_only=False`",
    "To copy construct from a tensor, it is recommended",  # of ns-render interpolate
    "std_mean\\(\\): degrees of freedom",  # of the scores of one test image
)
"""Beginnings of such warnings of torch and nerfstudio."""
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Of mallopt, in malloc.h."""
KEPT = 256 << 20
"""Freed bytes that are kept for the next use: more than a step takes beside the tables."""
OWN_MAPPING = 32 << 20
"""Bytes from which an array, such as a table, goes back to the system at once: glibc's upper limit."""
MALLOC_DEFAULT = 128 << 10
"""glibc's value of both thresholds at the start."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, ``kill``, and a terminal that is closed."""


@contextmanager
def _show_errors() -> Iterator[None]:
    """sys.excepthook: an InputError, a full disk or too little memory ends a command with a sentence alone, and Ctrl-C
    with a word."""
    before = sys.excepthook

    def show(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        says = used_up(error)  # by nerfstudio and torch too
        if os.environ.get(TRACEBACK) == "1" or not (says or issubclass(kind, (InputError, KeyboardInterrupt))):
            before(kind, error, traceback)
            return
        with suppress(OSError):  # which may be that full disk
            sys.stdout.flush()
        said = says or (error if issubclass(kind, InputError) else "Interrupted.")
        print(f"{Path(sys.argv[0]).stem}: {said}", file=sys.stderr, flush=True)

    sys.excepthook = show
    yield
    sys.excepthook = before


@contextmanager
def _hide_notices() -> Iterator[None]:
    """warnings.filters, CONSOLE.print, CONSOLE.log: nobody who trains can do anything about ``WARNINGS``, ``NOTICES``
    and the lines of nerfstudio's log."""
    plain = CONSOLE.print

    def print_for_users(*objects: Any, **how: Any) -> None:
        if not (objects and isinstance(objects[0], str) and objects[0].startswith(NOTICES)):
            plain(*objects, **how)

    if os.environ.get(TRACEBACK) != "1":
        vars(CONSOLE).update(print=print_for_users, log=lambda *_, **__: None)
    filters = list(warnings.filters)
    for message in WARNINGS:
        warnings.filterwarnings("ignore", message=message)
    yield
    warnings.filters[:] = filters  # type: ignore[index]
    for name in ("print", "log"):
        vars(CONSOLE).pop(name, None)


@contextmanager
def _outlive_readers() -> Iterator[None]:
    """CONSOLE.on_broken_pipe, CONSOLE._check_buffer: a pipe that nobody reads any more, or a closed terminal, ends no
    work, as rich would: Ctrl-C ends ``| tee`` at once, and a training after it has saved; a terminal refuses every word
    before its signal comes."""
    plain = CONSOLE._check_buffer

    def check_buffer() -> None:
        try:
            plain()
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            discard(1)

    vars(CONSOLE).update(on_broken_pipe=lambda: discard(1), _check_buffer=check_buffer)
    yield
    for name in ("on_broken_pipe", "_check_buffer"):
        vars(CONSOLE).pop(name, None)


@contextmanager
def keep_freed_memory() -> Iterator[None]:
    """glibc's malloc: a training step takes again what the last one freed. Its defaults give much of it back to the
    system, which then hands out zeroed pages: thousands of page faults a step. glibc adapts its defaults and cannot be
    asked for them, so the undo restores where they begin. Other C libraries are left as they are."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        yield
        return
    mallopt(TRIM_THRESHOLD, KEPT)
    mallopt(MMAP_THRESHOLD, OWN_MAPPING)
    yield
    mallopt(TRIM_THRESHOLD, MALLOC_DEFAULT)
    mallopt(MMAP_THRESHOLD, MALLOC_DEFAULT)


PATCHES = (_show_errors, _hide_notices, _outlive_readers)
TRAINING_PATCHES = (keep_freed_memory,)
"""Each makes a change of the host that lasts until it is undone; its docstring says of what, and why."""
_entered: dict[Callable[[], AbstractContextManager[None]], AbstractContextManager[None]] = {}


def command() -> str | None:
    """Name of the command that this process runs, of nerfstudio or ours; None in any other program."""
    program = Path(sys.argv[0]) if sys.argv and sys.argv[0] else Path("python")
    if program.stem.startswith(("ns-", "mmpi-")):
        return program.stem
    module = program.parent.as_posix().endswith(("nerfstudio/scripts", "mmpi_ns/scripts"))
    return f"ns-{program.stem}" if module else None


def arguments() -> list[str]:
    """The words after the command's name, options with hyphens for underscores; none in a program that is no
    command."""
    parts = [word.partition("=") if word.startswith("--") else (word, "", "") for word in sys.argv[1:]]
    words = [(name.replace("_", "-") if name.startswith("--") else name) + sign + value for name, sign, value in parts]
    return words if command() else []


def values_of(option: str) -> list[str]:
    """The words that follow an option of the command, up to the next one; none where it is not given."""
    words = [part for word in arguments() for part in (word.split("=", 1) if word.startswith("--") else [word])]
    behind = words[words.index(option) + 1 :] if option in words else []
    return list(takewhile(lambda word: not word.startswith("--"), behind))


def enter_command(training: bool = False) -> None:
    """Makes the patches once, those of training if asked for, if this process runs a command.

    nerfstudio's commands have no hook for this, so it is called by the first code of ours that each of them runs.
    """
    for patch in (*PATCHES, *(TRAINING_PATCHES if training else ())) if command() is not None else ():
        if patch not in _entered:
            _entered[patch] = patch()
            _entered[patch].__enter__()


def undo() -> None:
    """Takes all patches back, the last one first."""
    while _entered:
        _entered.popitem()[1].__exit__(None, None, None)


def give_back_freed_memory() -> None:
    """Makes glibc give back its unused memory: tables that grow do not fit into what steps leave."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):  # another C library
        return


def discard(output: int) -> None:
    """Whatever is written to stdout (1) or stderr (2) from now on, or waits to be, goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), output)


# For a block ---------------------------------------------------------------------------------------------------------


@contextmanager
def transforms_changed(parser: ModuleType, change: Callable[[Any, Path], Any]) -> Iterator[None]:
    """Within the block nerfstudio's parser sees what ``change`` makes of the content of a transforms.json.

    The parser reads the file and rounds to float32 in one function: this is the only place between.
    """
    read = parser.load_from_json
    parser.load_from_json = lambda path: change(read(path), path)  # type: ignore[attr-defined]
    try:
        yield
    finally:
        parser.load_from_json = read  # type: ignore[attr-defined]


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Within the block no trace function runs in this thread.

    The viewer stops a rendering by a trace function that raises before some line of Python. Where that line is the end
    of ``with lock:``, the lock would never be released.
    """
    trace = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(trace)


@contextmanager
def signals_go_to(handle: Callable[[int], object]) -> Iterator[None]:
    """Within the block the first of ``SIGNALS`` calls ``handle`` with its number; the next one has its usual effect.

    Has no effect outside the main thread, nor on a closed terminal where nohup has it ignored.
    """
    if current_thread() is not main_thread():
        yield
        return
    with ExitStack() as before:

        def first(number: int, _: object) -> None:
            before.close()
            if number == signal.SIGHUP:
                signal.signal(number, signal.SIG_IGN)  # the shell sends it again
                for output in (1, 2):
                    if stat.S_ISCHR(os.fstat(output).st_mode):  # the terminal, on which every word would be an error
                        discard(output)
            handle(number)

        for number in SIGNALS:
            usual = signal.getsignal(number)
            if number != signal.SIGHUP or usual != signal.SIG_IGN:
                before.callback(signal.signal, number, usual or signal.SIG_DFL)
                signal.signal(number, first)
        yield
