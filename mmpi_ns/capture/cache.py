"""Slow results that depend on files: kept in the user's cache folder, computed once by all processes."""

from __future__ import annotations

import hashlib
import os
import struct
import zipfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from mmpi_ns.utils.files import write_atomically

KEPT = 24
"""Number of cached results; the least recently used is removed first."""

Arrays = dict[str, NDArray[np.generic]]
Pairs = Iterable[tuple[str, NDArray[np.generic]]]


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/mmpi_ns``, by default in ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mmpi_ns"


def digest(files: Iterable[Path], *parts: object) -> str:
    """A key made of files (path, size, modification time), arrays and settings."""
    key = hashlib.sha256()
    for file in files:
        stat = file.stat()
        key.update(f"{file.resolve()} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    for part in parts:
        key.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return key.hexdigest()[:32]


def remembered(key: str, find: Callable[[], Arrays | Pairs], folder: Path | None = None) -> Arrays:
    """The result of ``find``, from the cache if the key is there.

    Arrays are mapped from the file: they take memory only where they are used, and the system may take it back.
    Changes are the caller's own and do not reach the file. If several processes ask at once, one computes and the
    others wait. If the folder is not writable, every process computes the result itself, and says so.

    Args:
        key: of the result.
        find: arrays by name; as pairs that are computed one by one they are written at once, never held together.
        folder: of the cache.
    """
    folder = folder or cache_folder()
    path = folder / f"{key}.npz"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / f"{key}.lock").acquire()
    except OSError as error:
        CONSOLE.print(f"[yellow]{folder} cannot be written to ({error.strerror}): depths are recomputed at each start.")
        return dict(find())
    with lock:
        arrays = _read(path)
        if arrays is None:
            result: Any = find()
            try:
                write_atomically(path, lambda unfinished: _write(unfinished, result))
                arrays = _read(path)
            except OSError as error:
                CONSOLE.print(f"[yellow]{error}")
            if arrays is None:
                arrays = result if isinstance(result, dict) else dict(find())
        _forget_old(folder)
    return arrays


def _write(path: Path, arrays: Arrays | Pairs) -> None:
    with zipfile.ZipFile(path, "w") as file:  # as np.savez, which asks for all arrays at once
        for name, array in arrays.items() if isinstance(arrays, dict) else arrays:
            with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(array), version=(1, 0), allow_pickle=False)


def _read(path: Path) -> Arrays | None:
    """The arrays of an uncompressed .npz, mapped; None if it is missing or damaged."""
    arrays = {}
    try:
        with zipfile.ZipFile(path) as file, path.open("rb") as data:
            for entry in file.infolist():
                data.seek(entry.header_offset + 26)  # of a zip's local header: lengths of name and extra field
                data.seek(sum(struct.unpack("<HH", data.read(4))), os.SEEK_CUR)
                np.lib.format.read_magic(data)
                shape, fortran, dtype = np.lib.format.read_array_header_1_0(data)
                order = "F" if fortran else "C"
                empty = 0 in shape  # nothing to map
                array = np.zeros(shape, dtype) if empty else np.memmap(path, dtype, "c", data.tell(), shape, order)
                arrays[entry.filename.removesuffix(".npy")] = np.asarray(array)
        path.touch()
    except (OSError, ValueError, EOFError, struct.error, zipfile.BadZipFile):
        return None
    return arrays


def _forget_old(folder: Path) -> None:
    """Removes the results beyond ``KEPT``, but none that a process computes or waits for."""
    files = sorted(folder.glob("*.npz"), key=lambda p: p.stat().st_mtime, reverse=True)
    for path in files[KEPT:]:
        with suppress(Timeout), FileLock(path.with_suffix(".lock"), timeout=0):
            path.unlink(missing_ok=True)
            path.with_suffix(".lock").unlink(missing_ok=True)
