"""Slow results that depend on files: kept in the user's cache folder, computed once by all processes."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from filelock import FileLock
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from mmpi_ns.utils.files import write_atomically

KEPT = 24
"""Results that are kept; the least recently used is removed first."""

Arrays = dict[str, NDArray[np.generic]]


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/mmpi_ns``, by default in ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mmpi_ns"


def digest(files: Iterable[Path], *parts: object) -> str:
    """A key made of files (path, size, modification time), arrays and settings."""
    found = hashlib.sha256()
    for file in files:
        stat = file.stat()
        found.update(f"{file.resolve()} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    for part in parts:
        found.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return found.hexdigest()[:32]


def remembered(key: str, find: Callable[[], Arrays], folder: Path | None = None) -> Arrays:
    """The result of ``find``, from the cache if the key is there.

    If several processes ask at once, one computes and the others wait. If the folder is not writable, every process
    computes the result itself, and says so.
    """
    folder = folder or cache_folder()
    path = folder / f"{key}.npz"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / f"{key}.lock").acquire()
    except OSError as error:
        CONSOLE.print(f"[yellow]{folder} cannot be written to ({error.strerror}): depths are recomputed at each start.")
        return find()
    with lock:
        known = _read(path)
        if known is None:
            known = find()
            try:
                write_atomically(path, lambda p: _write(p, known))  # type: ignore[arg-type]
            except OSError as error:
                CONSOLE.print(f"[yellow]{error}")
        _forget_old(folder)
    return known


def _write(path: Path, arrays: Arrays) -> None:
    with path.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _read(path: Path) -> Arrays | None:
    try:
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in stored.files}
        path.touch()
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
    return arrays


def _forget_old(folder: Path) -> None:
    files = sorted(folder.glob("*.npz"), key=lambda p: p.stat().st_mtime, reverse=True)
    for path in files[KEPT:]:
        path.unlink(missing_ok=True)
        path.with_suffix(".lock").unlink(missing_ok=True)
