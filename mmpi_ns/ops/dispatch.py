"""Operations, and the choice of their form: the reference in plain torch, C++ on a CPU, or Triton kernels on a GPU.

``--pipeline.model.ops`` chooses for the whole process. Without a compiler or Triton, the references run and the log
gives the reason. On a GPU, kernels are compared with the references before the first step (``training/agreement.py``).
"""

from __future__ import annotations

import functools
import importlib
import inspect
import os
import shutil
import sys
import sysconfig
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, Literal, ParamSpec, TypeVar, cast, get_type_hints

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from mmpi_ns.ops import build
from mmpi_ns.ops.layout import annotated
from mmpi_ns.settings import Route
from mmpi_ns.utils.errors import InputError, log

Form = Literal["reference", "cpu", "gpu"]

P = ParamSpec("P")
R = TypeVar("R")

OLDEST_TRITON = (3, 1)
"""Oldest Triton that compiles the kernels; part of torch since 2.5."""

_PRECISIONS = (torch.float32, torch.bfloat16)
_chosen: Route = "auto"
interpreting = False
"""Whether Triton's interpreter runs the GPU kernels on CPU tensors, for tests and rehearsals; very slow."""
_choosing = threading.RLock()


class Operation(Generic[P, R]):
    """A function defined in plain torch, with compiled forms of the same signature: for a CPU (C++, ``on_cpu``) and for
    a GPU (Triton, of the same name in the module ``gpu`` beside it). A call takes the form that suits its tensors.
    """

    def __init__(
        self, reference: Callable[P, R], compiled: tuple[Form, ...], in_cpp: int | None, kernels: str | None
    ) -> None:
        functools.update_wrapper(self, reference)
        self.reference, self.compiled = reference, list(compiled)
        self.name, self.signature = reference.__name__, inspect.signature(reference)
        self.kernels = kernels or reference.__module__
        """The module of its compiled forms, with ``gpu`` beside it."""
        self.folder = Path(str(sys.modules[self.kernels].__file__)).parents[1]
        """Folder of the package's operations, compiled into one library."""
        OPERATIONS[self.name] = self
        if in_cpp is not None:
            self.hints, self.least = get_type_hints(reference), in_cpp
            self.on_cpu(functools.update_wrapper(functools.partial(self._in_cpp), reference))

    def on_cpu(self, form: Callable[P, R]) -> Callable[P, R]:
        """Decorator of the form for a CPU."""
        self.compiled.append("cpu")
        self.cpu = form
        return form

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        form = form_of(self.name, *tensors_in((*args, *kwargs.values())))
        return function(self.name, form)(*args, **kwargs)

    def _in_cpp(self, *args: Any, **kwargs: Any) -> Any:
        """``mmpi_NAME(begin, end, *arguments, *sizes, *results)`` in C++ as the form for a CPU.

        Arguments are those of the definition, a named tuple's fields one by one; sizes what the letters in their
        annotations stand for, in the order in which they occur; results the tensor, or those of the named tuple, that
        it returns. Tensors of another type than annotated (int64 and float32, unless it names one) take the definition.
        """
        bound = self.signature.bind(*args, **kwargs)
        bound.apply_defaults()
        values, hints, forms, least = bound.args, self.hints, annotated(self.reference), self.least
        sizes, passed = {}, []
        for name, value in zip(self.signature.parameters, values, strict=True):
            is_group, tensors, owner = hasattr(value, "_asdict"), {name: value}, self.reference
            if not is_group and not isinstance(value, Tensor):
                passed.append(hints[name](value))
                continue
            if is_group:
                tensors, owner = cast(Any, value)._asdict(), type(value)
            for part, tensor in tensors.items():
                shape, kind = annotated(owner)[part]
                if tensor.dtype != kind:
                    return cast(Any, self.reference)(*values)
                sizes |= {letter: n for letter, n in zip(shape, tensor.shape, strict=True) if isinstance(letter, str)}
                passed.append(tensor.contiguous())
        columns = [forms["return"]] if "return" in forms else annotated(hints["return"]).values()
        results = [torch.empty([sizes.get(n, n) for n in shape], dtype=kind) for shape, kind in columns]
        parts = len(results[0]) if least else [0, len(results[0])]
        build.call_in_parts(
            f"mmpi_{self.name}", parts, *passed, *sizes.values(), *results, least=least, folder=self.folder
        )
        return results[0] if "return" in forms else hints["return"](*results)


OPERATIONS: dict[str, Operation[..., Any]] = {}
"""Imported operations by name."""


def operation(
    *compiled: Form, in_cpp: int | None = None, kernels: str | None = None
) -> Callable[[Callable[P, R]], Operation[P, R]]:
    """Decorator that makes a function an operation.

    Args:
        compiled: the forms in modules beside it.
        in_cpp: the form for a CPU is ``mmpi_NAME`` in C++ (``Operation._in_cpp``); rows of its first result that are
            worth another thread, 0: one thread computes all.
        kernels: module of the compiled forms, where it is not the definition's.
    """
    return functools.partial(Operation, compiled=compiled, in_cpp=in_cpp, kernels=kernels)


def on_gpu(x: Tensor) -> bool:
    """Whether the kernels of a GPU take a tensor, so that code must not synchronise."""
    return x.is_cuda or interpreting


def tensors_in(values: Iterable[Any]) -> Iterator[Tensor]:
    for x in values:
        if isinstance(x, Tensor):
            yield x
        elif isinstance(x, tuple):
            yield from tensors_in(x)


def form_of(name: str, *tensors: Tensor) -> Form:
    """The form for these tensors: a compiled one takes float32, integers and Adam's bfloat16 on one device."""
    operation = OPERATIONS[name]
    devices = {t.device.type for t in tensors}
    if _chosen == "torch" or any(t.is_floating_point() and t.dtype not in _PRECISIONS for t in tensors):
        return "reference"
    if devices == {"cpu"} and not interpreting:
        return "cpu" if "cpu" in operation.compiled and fault("C++", operation.folder) is None else "reference"
    if devices == ({"cpu"} if interpreting else {"cuda"}) and "gpu" in operation.compiled and fault("Triton") is None:
        return "gpu"
    return "reference"


@functools.cache
def function(name: str, form: Form) -> Any:
    """One form of an operation."""
    of = OPERATIONS[name]
    return getattr(of, form) if form != "gpu" else getattr(importlib.import_module(f"{of.kernels}.gpu"), name)


def choose(path: Route) -> None:
    """Sets the forms of the operations in this process. Raises InputError, with the reason, if ``native`` is requested
    and an operation has no compiled form here."""
    global _chosen
    _chosen = path
    if path != "native":
        return
    if reason := fault("Triton" if torch.cuda.is_available() or interpreting else "C++"):
        raise InputError(
            f"The compiled operations are not available ({reason}): use --pipeline.model.ops auto or torch."
        )


@contextmanager
def chosen(path: Route) -> Iterator[None]:
    """Within the block, operations use these forms."""
    global _chosen
    with _choosing:
        before, _chosen = _chosen, path
        try:
            yield
        finally:
            _chosen = before


@functools.cache
def fault(what: Literal["C++", "Triton"], folder: Path = build.OPS) -> str | None:
    """Reason why the compiler, for the operations in a folder, or Triton cannot be used; None if it can. Determined and
    logged once."""
    if what == "C++":
        try:
            if not build.library_file(folder).is_file():
                name = folder.parent.name
                CONSOLE.print(f"Compiling the inner loops of {name} for this processor: half a minute, once.")
            build.library(folder)
        except build.CannotCompile as error:
            return _log_reason(str(error))
        return None
    try:
        version = importlib.import_module("triton").__version__
    except ImportError as error:
        return _log_reason(f"Triton cannot be imported ({error})")
    if tuple(int(n) for n in version.split(".")[:2]) < OLDEST_TRITON:
        return _log_reason(f"Triton {version} is too old for the GPU's kernels, which need torch 2.5 or newer")
    if shutil.which(os.environ.get("CC", "gcc")) is None and shutil.which("clang") is None:
        return _log_reason("Triton finds no C compiler: install gcc")
    headers = Path(sysconfig.get_paths()["include"]) / "Python.h"
    if not headers.is_file():
        package = f"python{sysconfig.get_python_version()}-dev"
        return _log_reason(f"Triton needs Python's headers, and {headers} is missing: install {package}")
    return None


def _log_reason(reason: str) -> str:
    log(f"Plain torch instead of the compiled operations, several times slower: {reason}.")
    return reason
