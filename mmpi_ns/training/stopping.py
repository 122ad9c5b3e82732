"""Ctrl-C and SIGTERM: the current step is finished, the run is saved, and one sentence says how to resume."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def signals_go_to(handle: Callable[[int], object]) -> Iterator[None]:
    """Within the block the first Ctrl-C or SIGTERM calls ``handle`` with its number; the next one has its usual effect.

    Has no effect outside the main thread.
    """
    if current_thread() is not main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def first(number: int, _: object) -> None:
        restore()
        handle(number)

    for number in SIGNALS:
        signal.signal(number, first)
    try:
        yield
    finally:
        restore()


def end(number: int, sentence: str) -> NoReturn:
    """Ends the process with the exit status of the signal (130 after Ctrl-C) and a sentence."""
    sys.stdout.flush()
    print(sentence, file=sys.stderr, flush=True)
    raise SystemExit(128 + number)


def end_before_training(number: int) -> NoReturn:
    """Handles signals that arrive while a run is prepared."""
    end(number, "Stopped before the first step: there is nothing to go on from.")
