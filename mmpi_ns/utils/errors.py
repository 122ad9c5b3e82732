"""What is said when something that a user gave cannot be used: one sentence, and no traceback below it."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from types import TracebackType

TRACEBACK = "MMPI_TRACEBACK"
"""Set to 1 in the environment it shows the traceback of every error."""
NOT_FOR_USERS = (
    "Using a non-tuple sequence for multidimensional indexing",
    "`torch.cuda.amp",
    "Detected call of `lr_scheduler.step\\(\\)` before `optimizer.step\\(\\)`",  # parameters that are frozen at first
    "Sparse invariant checks are implicitly disabled",
    "You are using `torch.load` with `weights_only=False`",
)
"""How warnings of torch and nerfstudio begin that nobody who trains can do anything about."""


class InputError(ValueError):
    """What a user gave cannot be used. The message is one sentence: what is wrong, where, and what to do."""


class WriteError(InputError, OSError):
    """A file or folder cannot be written; one sentence as well."""


def brief(error: BaseException) -> str:
    """What an error says, cut after its first sentence: it goes in brackets into a sentence of ours."""
    return str(error).strip().split("\n")[0].split(". ")[0].rstrip(" .")


def speak_plainly() -> None:
    """From now on an ``InputError`` ends this process with its sentence alone, and torch's own notices are not shown.

    nerfstudio's commands are its own, so this is called by the first code of ours that each of them runs.
    """
    for message in NOT_FOR_USERS:
        warnings.filterwarnings("ignore", message=message)
    sys.excepthook = _show


def _show(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    if os.environ.get(TRACEBACK) == "1" or not issubclass(kind, InputError):
        sys.__excepthook__(kind, error, traceback)
        return
    sys.stdout.flush()
    print(f"{Path(sys.argv[0]).stem}: {error}", file=sys.stderr, flush=True)
