"""Ctrl-C and SIGTERM: the step at hand is finished, the run is saved, and one sentence says how to go on."""

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
    """Within the block the first Ctrl-C or SIGTERM calls ``handle`` with its number, and the next does what it did.

    In other threads than the main one nothing is changed.
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
    """Ends the process as one that a signal ended, 130 after Ctrl-C, with a sentence."""
    sys.stdout.flush()
    print(sentence, file=sys.stderr, flush=True)
    raise SystemExit(128 + number)


def end_before_training(number: int) -> NoReturn:
    """For signals that come while a run is prepared."""
    end(number, "Stopped before the first step: there is nothing to go on from.")
