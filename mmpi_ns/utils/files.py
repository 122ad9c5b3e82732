"""Atomic files, images that may be damaged, and arrays on disk."""

from __future__ import annotations

import os
import re
import shutil
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mmpi_ns.utils.errors import InputError, WriteError, brief

Arrays = Mapping[str, NDArray[np.generic]]
Pairs = Iterable[tuple[str, NDArray[np.generic]]]
# Pillow reports damaged files by any of these (SyntaxError: a broken PNG chunk), nerfstudio odd shapes by assertions.
UNREADABLE = (OSError, SyntaxError, ValueError, AssertionError, EOFError, Image.DecompressionBombError)


def natural_key(text: str) -> list[tuple[int, int | str]]:
    """Sort key by which 9 comes before 10."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", text) if part]


@contextmanager
def opened(name: Path) -> Iterator[Image.Image]:
    """An image file that is read within the block; InputError names it where that cannot be done."""
    try:
        with Image.open(name) as image:
            yield image
    except UNREADABLE as error:
        raise InputError(f"Image {name} cannot be read ({brief(error)}): repair it or leave it out.") from error


def write_atomically(path: Path, write: Callable[[Path], object], folder: Path | None = None) -> None:
    """Calls ``write`` with a temporary path on the same disk, in ``folder`` or beside the finished file, and renames
    it; removes it if writing fails. Raises WriteError with the reason and the free space."""
    temporary = (folder or path.parent) / f".{path.name}.{os.getpid()}.tmp"
    try:
        write(temporary)
        with open(temporary, "rb+") as file:  # on the disk before the name is: a power cut would leave an empty file
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # torch.save has a RuntimeError, without a reason, for a full disk
        free = shutil.disk_usage(temporary.parent).free / 2**20
        temporary.unlink(missing_ok=True)
        raise WriteError(
            f"{path} could not be written ({brief(error)}; {free:.0f} MB free): earlier files are "
            f"untouched, so make room and start again."
        ) from error
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary path to write to, which replaces the file at the end, so that the file is complete or absent.

    For one of many files that are made again after an interruption: unlike ``write_atomically`` it neither translates
    errors nor waits for the disk.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    yield partial
    os.replace(partial, path)


def write_text(path: Path, text: str) -> None:
    """Writes a ``whole`` file."""
    with whole(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_plan(path: Path, text: str) -> None:
    """Writes a plan.json. Another one that is there, which its user may have edited, is kept as plan.json.before."""
    if path.is_file() and path.read_bytes() != text.encode():
        os.replace(path, path.with_name(path.name + ".before"))
    write_text(path, text)


@contextmanager
def write_errors(folder: Path, option: str) -> Iterator[None]:
    """Errors of writing in a folder, within the block: WriteError with the option that names another folder."""
    try:
        yield
    except OSError as error:
        raise WriteError(f"{folder} cannot be written ({brief(error)}): choose another {option}.") from error


def make_writable(folder: Path, option: str) -> None:
    """Makes the folder of a result before the work on it, and tries to write there; errors as ``write_errors``."""
    with write_errors(folder, option):
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/mmpi_ns``, by default in ``~/.cache``: the cache of computed and compiled results."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mmpi_ns"


def write_arrays(path: Path, arrays: Arrays | Pairs) -> None:
    """Writes an .npz, whatever the file's ending."""
    with zipfile.ZipFile(path, "w") as file:  # as np.savez, which asks for all arrays at once
        for name, array in arrays.items() if isinstance(arrays, Mapping) else arrays:
            with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(array), version=(1, 0), allow_pickle=False)
