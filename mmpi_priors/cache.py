"""Cache of slow results that depend on files, in the user's cache folder; processes share them."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np
from filelock import FileLock, Timeout
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.utils.files import Arrays, Pairs, cache_folder, write_arrays, write_atomically

VERSION = 2
"""Version of all cached results: those of another version are computed again."""
KEPT = 24
"""Number of cached results; the least recently used is removed first."""

MOST_BYTES = 10e9
"""Bytes of all cached results; the last one is kept whatever its size."""

HELD, HELD_BYTES = 32, 2**28
"""Images kept in memory while their neighbours are compared with them, and bytes that they may take."""

T = TypeVar("T")


def digest(files: Iterable[Path], *parts: object) -> str:
    """A key made of files (path, size, modification time), arrays and settings."""
    key = hashlib.sha256()
    for file in files:
        stat = file.stat()
        key.update(f"{file.resolve()} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    for part in parts:
        key.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return key.hexdigest()[:32]


@dataclass(frozen=True, eq=False)
class Computed(Sequence[T]):
    """Results of a function of 0 to n - 1, computed at every access, so that they take no memory."""

    length: int
    function: Callable[[int], T]

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, i: Any) -> Any:
        if not 0 <= i < self.length:
            raise IndexError(i)
        return self.function(i)


def held(
    function: Callable[[int], T], sizes: NDArray[np.float64], bytes_of_pixel: int, least: int
) -> Callable[[int], T]:
    """A function of an image's number that caches its last results while neighbours are compared with them.

    Threads that ask for the same image at once share one call. Results of images of these sizes [M, 2] are kept as long
    as they take ``HELD_BYTES`` at most, but ``least`` in any case: as many as an image is compared with.
    """
    bytes_of_image = bytes_of_pixel * float(sizes.prod(-1).max())

    most = max(least, min(HELD, int(HELD_BYTES / bytes_of_image)))
    entry: Callable[[int], tuple[Lock, list[T]]] = lru_cache(most)(lambda _: (Lock(), []))

    def result(i: int) -> T:
        lock, results = entry(i)
        with lock:
            if not results:
                results.append(function(i))
        return results[0]

    return result


def kept(name: str, images: PosedImages, settings: Sequence[object], find: Callable[[], Arrays | Pairs]) -> Arrays:
    """The result of ``find`` (see ``remembered``), cached under this name for these images, their cameras and
    settings."""
    cameras = images.camera_to_worlds, images.intrinsics, images.distortion, images.fisheye
    return remembered(digest(images.files, name, VERSION, *cameras, *settings), find)


def remembered(key: str, find: Callable[[], Arrays | Pairs], folder: Path | None = None) -> Arrays:
    """The result of ``find``, from the cache if the key is there.

    Arrays are read from the file at each access, so they take memory only while they are used, and changes to them are
    not kept. If several processes ask at once, one computes and the others wait. If the folder is not writable, every
    process computes the result and prints a note.

    ``find`` gives arrays by name; pairs that are computed one by one are written one by one.
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
        for left in folder.glob(f".{path.name}.*.tmp"):  # by a process that was killed, as this one has the lock
            left.unlink(missing_ok=True)
        arrays = _read(path)
        if arrays is None:
            result: Any = find()
            try:
                write_atomically(path, lambda unfinished: write_arrays(unfinished, result))
                arrays = _read(path)
            except OSError as error:
                CONSOLE.print(f"[yellow]{error}")
            if arrays is None:
                arrays = result if isinstance(result, Mapping) else dict(find())
        # Results beyond KEPT and MOST_BYTES go, but none that a process computes or waits for.
        files = sorted(folder.glob("*.npz"), key=lambda p: p.stat().st_mtime, reverse=True)
        sizes = np.cumsum([file.stat().st_size for file in files])
        for old in files[min(KEPT, max(1, int((sizes <= MOST_BYTES).sum()))) :]:
            with suppress(Timeout), FileLock(old.with_suffix(".lock"), timeout=0):
                old.unlink(missing_ok=True)
                old.with_suffix(".lock").unlink(missing_ok=True)
    return arrays


def _read(path: Path) -> Arrays | None:
    """The arrays of an .npz, which stays open, as others may remove it meanwhile; None if it is missing or damaged."""
    with suppress(OSError, ValueError, EOFError, zipfile.BadZipFile):
        arrays = np.load(path)
        path.touch()
        return arrays
    return None
