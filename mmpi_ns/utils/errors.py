"""What is said when something that a user gave cannot be used: one sentence, and no traceback below it."""

from __future__ import annotations

import shlex
from pathlib import Path


class InputError(ValueError):
    """What a user gave cannot be used. The message is one sentence: what is wrong, where, and what to do."""


class WriteError(InputError, OSError):
    """A file or folder cannot be written; one sentence as well."""


def brief(error: BaseException) -> str:
    """What an error says, cut after its first sentence: it goes in brackets into a sentence of ours."""
    return str(error).strip().split("\n")[0].split(". ")[0].rstrip(" .")


def quoted(path: Path) -> str:
    """A path as a shell takes it, for a command to be copied."""
    return shlex.quote(str(path))
