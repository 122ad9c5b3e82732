"""Locks in code that nerfstudio's viewer interrupts."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any


class Uninterrupted:
    """No trace function runs in this thread within the block.

    The viewer stops a rendering by a trace function that raises before some line of Python. Where that line is the end
    of ``with lock:``, the lock would never be released.
    """

    def __enter__(self) -> None:
        self._trace: Any = sys.gettrace()
        sys.settrace(None)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        sys.settrace(self._trace)
