"""Choice of the form of an operation: its reference in plain torch, C++ on a CPU, or Triton kernels on a GPU.

``--pipeline.model.ops`` chooses for the whole process. Where a compiled form cannot be had, or does not do on this
device what the reference does (``trial.py``), that operation alone falls back to its reference, and the log says why.
"""

from __future__ import annotations

import functools
import importlib
import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from mmpi_ns.ops import build
from mmpi_ns.utils.errors import InputError

Route = Literal["auto", "torch", "native"]
Form = Literal["reference", "cpu", "gpu"]

TABLE: dict[str, tuple[str, tuple[Form, ...]]] = {
    # operation: its folder, and which compiled forms there are beside the reference
    "march": ("march", ("cpu", "gpu")),
    "order_by_head": ("interpolate", ("cpu",)),
    "texel_rows": ("interpolate", ("cpu", "gpu")),
    "weighted_rows": ("interpolate", ("gpu",)),
    "take_rows": ("interpolate", ("cpu",)),
    "index_rows": ("interpolate", ("cpu", "gpu")),
    "raise_peaks": ("interpolate", ("cpu",)),
    "sum_rows": ("interpolate", ("cpu", "gpu")),
    "composite_weights": ("composite", ("cpu", "gpu")),
    "total_variation": ("variation", ("cpu", "gpu")),
    "adam_rows": ("adam", ("cpu", "gpu")),
    "gather_taps": ("gather", ("cpu", "gpu")),
    "show_rays": ("march", ("cpu", "gpu")),
    "shade": ("shade", ("cpu",)),
    "show_baked": ("baked", ("cpu",)),
    "splat_image": ("splat", ("cpu",)),
    "splat_sums": ("splat", ("cpu",)),
    "splat_opacities": ("splat", ("cpu",)),
    "shade_baked": ("baked", ("cpu",)),
}
"""Every operation. Its function has the same name and signature in ``reference.py``, ``cpu.py`` and ``gpu.py``."""

OLDEST_TRITON = (3, 1)
"""The kernels compile with this and newer ones; torch brings it since 2.5."""

_PRECISIONS = (torch.float32, torch.bfloat16)
_chosen: Route = "auto"
_interpreting = False
_faults: dict[str, str | None] = {}
"""What is known of the compiler ("C++"), of Triton, and of each operation's GPU form: None is well, else why not."""
_trying = threading.RLock()


def run(name: str, *given: Any) -> Any:
    """Runs the operation in the form that suits the tensors among its arguments."""
    form = form_of(name, *_tensors(given))
    if form != "gpu" or _chosen == "native":
        return function(name, form)(*given)
    try:
        return function(name, "gpu")(*given)
    except Exception as error:
        if not _did_not_compile(error):
            raise
        # A shape that the trial did not have; nothing has run.
        _faults[name] = _say(f"{name} does not compile for this GPU ({_words(error)})", f"Plain torch for {name}")
        return function(name, "reference")(*given)


def _tensors(given: Iterable[Any]) -> Iterator[Tensor]:
    for x in given:
        if isinstance(x, Tensor):
            yield x
        elif isinstance(x, tuple):
            yield from _tensors(x)


def form_of(name: str, *tensors: Tensor) -> Form:
    """The form for these tensors: a compiled one takes float32, integers and Adam's bfloat16 on one device."""
    compiled = TABLE[name][1]
    devices = {t.device.type for t in tensors}
    if _chosen == "torch" or any(t.is_floating_point() and t.dtype not in _PRECISIONS for t in tensors):
        return "reference"
    if devices == {"cpu"} and not _interpreting:
        return "cpu" if "cpu" in compiled and fault("C++") is None else "reference"
    if devices == ({"cpu"} if _interpreting else {"cuda"}) and "gpu" in compiled and fault(name) is None:
        return "gpu"
    return "reference"


def on_device(tensor: Tensor) -> bool:
    """Whether reading a tensor synchronises: it is on a GPU, or treated as if it were (``interpret``)."""
    return tensor.device.type != "cpu" or _interpreting


@functools.cache
def function(name: str, form: Form) -> Any:
    """One form of an operation."""
    return getattr(importlib.import_module(f"mmpi_ns.ops.{TABLE[name][0]}.{form}"), name)


def choose(path: Route) -> None:
    """Sets the forms of the operations in this process.

    Raises:
        ValueError: ``native`` is asked for, and an operation has no compiled form here (says why).
    """
    global _chosen
    _chosen = path
    if path != "native":
        return
    on_gpu = torch.cuda.is_available() or _interpreting
    names = ["Triton", *(n for n in TABLE if "gpu" in TABLE[n][1])] if on_gpu else ["C++"]
    if reason := next((r for n in names if (r := fault(n)) is not None), None):
        raise InputError(f"The compiled operations cannot be had ({reason}): use --pipeline.model.ops auto or torch.")


@contextmanager
def chosen(path: Route) -> Iterator[None]:
    """Within the block, operations use these forms."""
    global _chosen
    with _trying:
        before, _chosen = _chosen, path
        try:
            yield
        finally:
            _chosen = before


def interpret(on: bool) -> None:
    """Makes Triton's interpreter run the GPU kernels on CPU tensors, for tests and rehearsals; very slow.

    Raises:
        ValueError: TRITON_INTERPRET=1 was not in the environment when the process started, or there is no Triton.
    """
    global _interpreting
    if on and os.environ.get("TRITON_INTERPRET") != "1":
        raise ValueError("Triton's interpreter must be asked for before Python starts: set TRITON_INTERPRET=1.")
    if on and (reason := fault("Triton")) is not None:
        raise ValueError(f"Triton cannot be had: {reason}.")
    _interpreting = on


def fault(name: str) -> str | None:
    """Why the compiler, Triton or an operation's GPU form cannot be used; determined and logged once."""
    if name not in _faults:
        with _trying:
            if name not in _faults:
                _faults[name] = _try(name)
    return _faults[name]


def _try(name: str) -> str | None:
    if name == "C++":
        try:
            if not build.library_file().is_file():
                CONSOLE.print("Compiling the inner loops for this processor: half a minute, once.")
            build.library()
        except build.CannotCompile as error:
            return _say(str(error))
        return None
    if name == "Triton":
        try:
            version = importlib.import_module("triton").__version__
        except ImportError as error:
            return _say(f"Triton cannot be imported ({error})")
        if tuple(int(n) for n in version.split(".")[:2]) < OLDEST_TRITON:
            return _say(f"Triton {version} is too old for the GPU's kernels, which need torch 2.5 or newer")
        return None
    if (reason := fault("Triton")) is not None:
        return reason
    try:  # the module tries operations, so it comes after this one
        importlib.import_module("mmpi_ns.ops.trial").run(name, "cpu" if _interpreting else "cuda")
    except Exception as error:  # a driver, a compiler or a cache folder may fail in many ways: all mean plain torch
        return _say(f"its Triton kernel fails on this device ({_words(error)})", f"Plain torch for {name}")
    return None


def _did_not_compile(error: Exception) -> bool:
    """Whether this is Triton's, its compiler's or the assembler's complaint about a kernel."""
    if isinstance(error, importlib.import_module("triton.errors").TritonError):
        return True
    return isinstance(error, RuntimeError) and ("PassManager" in str(error) or "ptxas" in str(error))


def _words(error: Exception) -> str:
    """First informative line of an error."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0][:200]}" if lines else type(error).__name__


def _say(reason: str, instead: str = "Plain torch instead of the compiled operations") -> str:
    CONSOLE.print(f"{instead}, several times slower: {reason}.")
    return reason
