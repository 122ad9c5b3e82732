"""Signals and settings of malloc: temporary changes of the process."""

from __future__ import annotations

import ctypes
import os
import signal
import stat
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from threading import current_thread, main_thread
from typing import Any

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Of mallopt, in malloc.h."""
KEPT = 256 << 20
"""Freed bytes that malloc keeps: more than a step takes beside the tables."""
OWN_MAPPING = 32 << 20
"""Size from which a freed array is returned to the system at once: glibc's upper limit."""
MALLOC_DEFAULT = 128 << 10
"""glibc's value of both thresholds at the start."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, ``kill``, and a terminal that is closed."""


@contextmanager
def keep_freed_memory() -> Iterator[None]:
    """Within the block, glibc's malloc reuses the memory that the last training step freed. Its defaults return much of
    it to the system, which then supplies zeroed pages: thousands of page faults a step. glibc adapts its defaults and
    does not report them, so the initial ones are restored. Other C libraries are not changed."""
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


def give_back_freed_memory() -> None:
    """Makes glibc give back its unused memory: tables that grow do not fit into what steps leave."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):  # another C library
        return


def discard(output: int) -> None:
    """Discards further and buffered output to stdout (1) or stderr (2)."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), output)


@contextmanager
def signals_go_to(handle: Callable[[int], object]) -> Iterator[None]:
    """Within the block the first of ``SIGNALS`` calls ``handle`` with its number; the next one has its usual effect.

    Has no effect outside the main thread, nor on a closed terminal where nohup has it ignored.
    """
    if current_thread() is not main_thread():
        yield
        return
    hung_up: list[int] = []
    with ExitStack() as before:

        def restore(number: int, usual: Any) -> None:
            if number not in hung_up:  # the shell sends it again, at any moment
                signal.signal(number, usual)

        def first(number: int, _: object) -> None:
            if number == signal.SIGHUP:
                hung_up.append(number)
                signal.signal(number, signal.SIG_IGN)
                for output in (1, 2):
                    if stat.S_ISCHR(os.fstat(output).st_mode):  # the terminal, on which every word would be an error
                        discard(output)
            before.close()
            handle(number)

        for number in SIGNALS:
            usual = signal.getsignal(number)
            if number != signal.SIGHUP or usual != signal.SIG_IGN:
                before.callback(restore, number, usual or signal.SIG_DFL)
                signal.signal(number, first)
        yield
