"""Compilation of C++: the operations of each package become one library, at first use."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from mmpi_ns.utils.files import cache_folder
from mmpi_ns.utils.parallel import num_threads

OPS = Path(__file__).parent
"""Folder of the method's operations; the companion packages have such folders too."""
HEADERS = OPS / "cpp"
FLAGS = ["-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC", f"-I{HEADERS}"]
"""Compiler options; none reorders sums, so that results do not depend on the compiler."""
FORMS = {int: ctypes.c_int64, bool: ctypes.c_bool, float: ctypes.c_float}
"""C types of Python numbers."""
ENTRIES_PER_PART = 1024
"""Entries sampled to divide sums evenly among threads."""


class CannotCompile(Exception):
    """Compilation is not possible; the message is the reason."""


def compiler() -> list[str]:
    """The compiler and its arguments. Raises CannotCompile if there is none."""
    try:
        asked = shlex.split(os.environ.get("CXX", ""))  # a program and its arguments, ccache g++ for example
    except ValueError as error:
        raise CannotCompile(f"CXX is {os.environ['CXX']}, which is no command ({error})") from error
    program = asked or [path for name in ("g++", "clang++") if (path := shutil.which(name))][:1]
    if not program:
        raise CannotCompile("no C++ compiler (g++ or clang++) is installed")
    return program


def library_file(folder: Path = OPS) -> Path:
    """Path of the compiled library of the operations in a folder, with a name for each combination of sources, compiler
    and processor. Raises CannotCompile if there is no compiler, or there are no sources."""
    sources = sorted(folder.glob("*/*.cpp"))
    if not sources:
        raise CannotCompile(f"{folder} holds no C++ sources: install the package again")
    texts = [p.read_bytes() for p in [*sources, *sorted({*HEADERS.glob("*.h"), *folder.glob("cpp/*.h")})]]
    try:  # what -march=native depends on: different machines may share a home folder
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = "".join(sorted({x for x in lines if x.startswith(("model name", "flags", "Features"))}))
    except OSError:
        processor = f"{platform.machine()} {platform.processor()} {platform.node()}"
    parts = [*texts, " ".join([*compiler(), *FLAGS]).encode(), processor.encode()]
    key = hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]
    return cache_folder() / f"kernels-{key}.so"


@functools.cache
def library(folder: Path = OPS) -> ctypes.CDLL:
    """The compiled functions of a folder, from the cache if they have been compiled before. Raises CannotCompile if
    there is no compiler, or it fails."""
    target, command = library_file(folder), [*compiler(), *FLAGS, *map(str, sorted(folder.glob("*/*.cpp")))]
    try:
        if target.is_file():
            with suppress(OSError):  # cut short, or of a newer glibc: containers may share a home folder
                return ctypes.CDLL(str(target))
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            return _compiled(command, target, target.parent)
        except (OSError, subprocess.CalledProcessError):  # full or read-only: each process compiles its own
            return _compiled(command, target, None)
    except subprocess.CalledProcessError as error:
        words = (error.stderr or "").strip() or f"exit status {error.returncode}"
        raise CannotCompile(f"{command[0]} failed: {words.splitlines()[0]}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CannotCompile(str(error)) from error


def _compiled(command: list[str], target: Path, folder: Path | None) -> ctypes.CDLL:
    """The library, compiled in a folder on the target's disk and kept there, or in a temporary one."""
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        unfinished = Path(scratch) / target.name
        subprocess.run([*command, "-o", str(unfinished)], check=True, capture_output=True, text=True, timeout=600)
        built = ctypes.CDLL(str(unfinished))
        if folder is not None:
            os.replace(unfinished, target)
    return built


def arguments(values: Iterable[Any]) -> list[Any]:
    """Arguments of the compiled functions, and fields of their structs: addresses of contiguous tensors and of
    ``structs``, null for None, 64-bit integers, 32-bit floats; others unchanged."""
    passed = []
    for x in values:
        if isinstance(x, Tensor):
            assert x.is_contiguous(), x.stride()
            passed.append(ctypes.c_void_p(x.data_ptr()))
        elif x is None or isinstance(x, ctypes.Array):
            passed.append(ctypes.c_void_p(None if x is None else ctypes.addressof(x)))
        else:
            passed.append(FORMS[type(x)](x) if type(x) in FORMS else x)
    return passed


def structs(*rows: Sequence[Any]) -> ctypes.Array:
    """Contiguous C++ structs of these fields (see ``arguments``), which keep alive what they point to."""
    fields = [tuple(arguments(row)) for row in rows]
    array = (_struct(*map(type, fields[0])) * len(rows))(*fields)
    array.held = rows  # type: ignore[attr-defined]
    return array


@functools.cache
def _struct(*types: type) -> type[ctypes.Structure]:
    return type("Struct", (ctypes.Structure,), {"_fields_": [(f"_{i}", t) for i, t in enumerate(types)]})


def call_in_parts(name: str, parts: int | Sequence[int], *values: Any, least: int = 256, folder: Path = OPS) -> None:
    """Calls a compiled function of ``(begin, end, *values)`` for parts of a range, each by a thread
    (``cpp/parts.h``). Parts must not write to the same memory.

    Args:
        name: of the function.
        parts: bounds of the parts; of one number, even parts of 0 to that (``even_bounds``).
        values: further arguments (``arguments``).
        least: numbers of an even part, at least.
        folder: of the operations.
    """
    bounds = even_bounds(parts, least) if isinstance(parts, int) else parts
    how = (ctypes.c_int64 * len(bounds))(*bounds), ctypes.c_int64(len(bounds) - 1)
    _function(f"{name}_in_parts", folder)(*how, *arguments(values))


@functools.cache
def _function(name: str, folder: Path = OPS) -> Callable[..., int]:
    address = ctypes.c_void_p.in_dll(library(folder), name).value
    assert address is not None
    return ctypes.CFUNCTYPE(ctypes.c_int64)(address)


def even_bounds(count: int, least: int = 256) -> list[int]:
    """Bounds of parts of 0..count, one for each of torch's threads, as far as each gets ``least``."""
    parts = max(1, min(num_threads(), count // least))
    return [count * i // parts for i in range(parts + 1)]


def owned_bounds(positions: Sequence[Int[Tensor, "N B"]], count: int, least: int) -> list[int]:
    """Bounds of parts of rows 0..count with about as many entries each, for sums by row.

    One thread adds all entries of a row in order, so that sums do not depend on the bounds.

    Args:
        positions: rows of all entries, of which a sample is read.
        count: of the rows.
        least: entries that each part gets (see ``even_bounds``).
    """
    entries = sum(p.numel() for p in positions)
    parts = len(even_bounds(entries, least)) - 1
    if parts == 1:
        return [0, count]
    some = torch.cat([p.reshape(-1)[:: 1 + entries // ENTRIES_PER_PART // parts] for p in positions]).sort().values
    inner = some[[len(some) * i // parts for i in range(1, parts)]].tolist()
    return [0, *sorted({n for n in inner if 0 < n < count}), count]
