"""Resuming an interrupted preparation: each stage records what it was made from."""

from __future__ import annotations

import errno
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from mmpi_ns.utils.errors import InputError, say
from mmpi_ns.utils.files import write_text

FULL = (errno.ENOSPC, errno.EDQUOT)
LEFT = 1 << 20
"""Free bytes below which a failure to write is attributed to a full disk; COLMAP's errors give no reason."""


@dataclass
class Stages:
    """Stages of a preparation, run in order; a stage that was finished with the same settings is skipped.

    A stage is valid while its own settings and those of all earlier ones are unchanged; the first that changed is
    emptied, and so are all after it. An interrupted stage finds its own partial output again.
    """

    work: Path
    """Folder of all stages."""
    _key: str = ""

    def run(self, name: str, settings: Any, make: Callable[[Path], Any]) -> tuple[Path, Any]:
        """A stage's own folder, and what the work on it returned, now or before.

        Args:
            name: the folder's name.
            settings: everything the result depends on besides the earlier stages; JSON or text.
            make: fills the folder, and returns JSON.
        """
        text = self._key + name + json.dumps(settings, sort_keys=True, default=str)
        self._key = hashlib.sha256(text.encode()).hexdigest()
        folder, stamp = self.work / name, self.work / f"{name}.json"
        try:
            state = json.loads(stamp.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            state = {}  # missing or truncated: the stage starts over
        if state.get("key") != self._key:
            shutil.rmtree(folder, ignore_errors=True)
            write_text(stamp, json.dumps({"key": self._key}))
        elif "result" in state:
            say(f"{name}: done before", "dim")
            return folder, state["result"]
        folder.mkdir(exist_ok=True)
        result = make(folder)
        write_text(stamp, json.dumps({"key": self._key, "result": result}))
        return folder, result


@contextmanager
def only_one(work: Path) -> Iterator[None]:
    """Locks a work folder against a second run. Raises InputError if one is at work there, or the disk is full."""
    work.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(work / "lock", blocking=False):
            yield
    except Timeout as error:
        raise InputError(f"Another mmpi-prepare is making {work.parent}: wait for it, or name another.") from error
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError) as error:
        free = shutil.disk_usage(work.parent).free
        if getattr(error, "errno", None) in FULL or free < LEFT:
            says = f"The disk of {work.parent} is full ({free / 2**20:.0f} MB free): make room and repeat the command."
            raise InputError(says) from error
        raise
