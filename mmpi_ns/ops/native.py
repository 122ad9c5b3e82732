"""The fast paths. On a CPU: kernels in ``cpp``, compiled by the machine's own C++ compiler at first use (4 seconds).
On a GPU: Triton kernels in ``triton_*.py``, compiled by Triton, which comes with torch on Linux.

Which path runs is one setting of the process, ``choose``: ``auto`` takes the kernels where they can be had and says so
where they cannot. Every kernel has a reference in plain torch under the same signature.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

Route = Literal["auto", "torch", "native"]
FLAGS = ["-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC"]
"""Nothing that reorders sums: a result never depends on how the compiler groups them."""
SOURCES = Path(__file__).parent / "cpp"

_OTHER_FLOATS = (torch.float16, torch.bfloat16, torch.float64)
_chosen: Route = "auto"
_interpreting = False


def choose(path: Route) -> None:
    """Sets which path the operations of this process take.

    Raises:
        ValueError: ``native`` is asked for and cannot be built (says why).
    """
    global _chosen
    _chosen = path
    if path != "native":
        return
    reason = _triton_fault() if torch.cuda.is_available() or _interpreting else _build()
    if isinstance(reason, str):
        raise ValueError(f"The compiled kernels cannot be had: {reason}. Use --pipeline.model.ops auto or torch.")


def interpret(on: bool) -> None:
    """Lets Triton's interpreter run the GPU's kernels on CPU tensors: for tests and rehearsals, and very slow.

    Raises:
        ValueError: TRITON_INTERPRET=1 was not in the environment when the process started, or there is no Triton.
    """
    global _interpreting
    if on and os.environ.get("TRITON_INTERPRET") != "1":
        raise ValueError("Triton's interpreter must be asked for before Python starts: set TRITON_INTERPRET=1.")
    _interpreting = on
    if on and (reason := _triton_fault()) is not None:
        _interpreting = False
        raise ValueError(f"Triton cannot be had: {reason}.")


def takes_triton(*tensors: Tensor) -> bool:
    """Whether the Triton kernels are wanted, can be had and take these tensors (float32, or integers, on a GPU)."""
    if _chosen == "torch" or any(t.dtype in _OTHER_FLOATS for t in tensors):
        return False
    devices = {t.device.type for t in tensors}
    if devices == {"cpu"}:
        return _interpreting
    return devices == {"cuda"} and not _interpreting and _triton_fault() is None


def library(*tensors: Tensor) -> ctypes.CDLL | None:
    """The compiled kernels, where they are wanted, can be had and take these tensors (float32 on a CPU)."""
    if _chosen == "torch" or _interpreting:
        return None
    if any(t.device.type != "cpu" or t.dtype != torch.float32 for t in tensors):
        return None
    built = _build()
    return None if isinstance(built, str) else built


def address(tensor: Tensor, dtype: torch.dtype = torch.float32) -> ctypes.c_void_p:
    """Where a tensor's numbers lie, for a kernel that expects them close together."""
    assert tensor.dtype == dtype and tensor.is_contiguous(), (tensor.dtype, tensor.stride())
    return ctypes.c_void_p(tensor.data_ptr())


def in_parts(work: Callable[[int, int], None], count: int, least: int = 256) -> None:
    """Calls work(begin, end) for parts of 0..count, on as many threads as torch uses. Parts must not meet."""
    threads = max(1, min(torch.get_num_threads(), count // least))
    if threads == 1:
        return work(0, count)
    bounds = [count * i // threads for i in range(threads + 1)]
    parts = [_pool(threads).submit(work, a, b) for a, b in pairwise(bounds)]
    try:
        for part in parts:
            part.result()
    finally:
        wait(parts)  # also when interrupted: the caller's tensors are freed then, and the kernels write to them


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="mmpi")


@functools.cache
def _build() -> ctypes.CDLL | str:
    """The library, compiled unless it is in the cache, or why there is none (also said once in the log)."""
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        return _unavailable("no C++ compiler (g++ or clang++) is installed")
    sources = sorted(SOURCES.glob("*.cpp"))
    if not sources:
        return _unavailable(f"{SOURCES} holds no sources: install the package again")
    texts = [p.read_bytes() for p in sorted(SOURCES.iterdir()) if p.suffix in (".cpp", ".h")]
    key = hashlib.sha256(b"\0".join([*texts, " ".join([compiler, *FLAGS]).encode(), _processor()])).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mmpi_ns"
    target = folder / f"kernels-{key}.so"
    try:
        if not target.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder) as scratch:
                made = Path(scratch) / target.name
                command = [compiler, *FLAGS, "-o", str(made), *map(str, sources)]
                subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
                os.replace(made, target)
        built = ctypes.CDLL(str(target))
    except subprocess.CalledProcessError as error:
        return _unavailable(f"{compiler} failed: {(error.stderr or '').strip().splitlines()[:1]}")
    except (OSError, subprocess.TimeoutExpired) as error:
        return _unavailable(str(error))
    built.mmpi_index_rows.restype = ctypes.c_int64
    return built


def _processor() -> bytes:
    """What -march=native depends on: a home folder may be shared by machines that differ."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return "".join(sorted({x for x in lines if x.startswith(("model name", "flags", "Features"))})).encode()
    except OSError:
        return f"{platform.machine()} {platform.processor()} {platform.node()}".encode()


@functools.cache
def _triton_fault() -> str | None:
    """Why the Triton kernels cannot be had (also said once in the log); None where they can."""
    try:
        from mmpi_ns.ops.triton_tables import works
    except ImportError as error:
        return _unavailable(f"Triton cannot be imported ({error})")
    try:
        works("cpu" if _interpreting else "cuda")
    except Exception as error:  # a driver, a compiler or a cache folder may fail in many ways: all mean plain torch
        return _unavailable(f"Triton does not run here ({type(error).__name__}: {error})")
    return None


def _unavailable(reason: str) -> str:
    CONSOLE.print(f"Plain torch instead of the compiled kernels, which are several times faster: {reason}.")
    return reason
