"""Operations, and the choice of their form: the reference in plain torch, C++ on a CPU, or Triton kernels on a GPU.

``--pipeline.model.ops`` chooses for the whole process. Where a compiled form is not available, or does not do on this
device what the reference does (``trial.py``), that operation alone falls back to its reference, and the log says why.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import subprocess
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
from mmpi_ns.ops.layout import SMALL, Shapes, annotated, check_shapes
from mmpi_ns.utils.errors import InputError, brief, say

Route = Literal["auto", "torch", "native"]
Form = Literal["reference", "cpu", "gpu"]

P = ParamSpec("P")
R = TypeVar("R")

OLDEST_TRITON = (3, 1)
"""The kernels compile with this and newer ones; torch brings it since 2.5."""

_PRECISIONS = (torch.float32, torch.bfloat16)
_chosen: Route = "auto"
interpreting = False
"""Whether Triton's interpreter runs the GPU kernels on CPU tensors, for tests and rehearsals; very slow."""
_faults: dict[str, str | None] = {}
"""What is known of the compiler ("C++"), of Triton, and of each operation's GPU form: None is well, else why not."""
_trying = threading.RLock()
_shapes = SMALL
"""What kernels are tried with."""
_tries_afresh = False


class Operation(Generic[P, R]):
    """A function that is defined in plain torch, with compiled forms of the same signature: for a CPU (C++, ``on_cpu``)
    and for a GPU (Triton, of the same name in the module ``gpu`` beside it). A call takes the form that suits the
    tensors among its arguments.

    Raises:
        ValueError: by a call: the shape of a tensor is not that of its annotation (``layout.py``).
    """

    def __init__(
        self,
        reference: Callable[P, R],
        compiled: tuple[Form, ...],
        check: Callable[..., None] | None,
        in_cpp: int | None,
    ) -> None:
        functools.update_wrapper(self, reference)
        self.reference, self.compiled, self.check = reference, list(compiled), check
        self.name, self.signature = reference.__name__, inspect.signature(reference)
        _OPERATIONS[self.name] = self
        if in_cpp is not None:
            self.hints, self.least = get_type_hints(reference), in_cpp
            self.on_cpu(functools.update_wrapper(functools.partial(self._in_cpp), reference))

    def on_cpu(self, form: Callable[P, R]) -> Callable[P, R]:
        """Makes a function the form for a CPU."""
        self.compiled.append("cpu")
        self.cpu = form
        return form

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        names = self.signature.parameters
        if kwargs or len(args) != len(names):
            bound = self.signature.bind(*args, **kwargs)
            bound.apply_defaults()
            arguments = bound.arguments
        else:
            arguments = dict(zip(names, args, strict=True))
        check_shapes(self.reference, arguments)
        values = tuple(arguments.values())
        if self.check is not None:
            self.check(*values)
        form = form_of(self.name, *tensors_in(values))
        if form != "gpu" or _chosen == "native":
            return function(self.name, form)(*values)
        try:
            return function(self.name, "gpu")(*values)
        except Exception as error:  # Triton's, its compiler's or the assembler's complaint about a kernel, or another
            complaint = isinstance(error, RuntimeError) and ("PassManager" in str(error) or "ptxas" in str(error))
            if not complaint and not isinstance(error, importlib.import_module("triton.errors").TritonError):
                raise
            # A shape that the trial did not have; nothing has run.
            reason = f"{self.name} does not compile for this GPU ({type(error).__name__}: {brief(error)[:200]})"
            _faults[self.name] = _say(reason, f"Plain torch for {self.name}")
            return function(self.name, "reference")(*values)

    def _in_cpp(self, *values: Any) -> Any:
        """``mmpi_NAME(begin, end, *arguments, *sizes, *results)`` in C++ as the form for a CPU.

        Arguments are those of the definition, a named tuple's fields one by one; sizes what the letters in their
        annotations stand for, in the order in which they occur; results the tensor, or those of the named tuple, that
        it returns. Tensors of another type than annotated (int64 and float32, unless it names one) take the definition.
        """
        hints, forms, least, sizes, passed = self.hints, annotated(self.reference), self.least, {}, []
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
        build.call_in_parts(f"mmpi_{self.name}", parts, *passed, *sizes.values(), *results, least=least)
        return results[0] if "return" in forms else hints["return"](*results)


_OPERATIONS: dict[str, Operation[..., Any]] = {}


def operation(
    *compiled: Form, check: Callable[..., None] | None = None, in_cpp: int | None = None
) -> Callable[[Callable[P, R]], Operation[P, R]]:
    """Makes an operation of a function.

    Args:
        compiled: the forms in modules beside it.
        check: takes the same arguments and raises what their annotations cannot say.
        in_cpp: the form for a CPU is ``mmpi_NAME`` in C++ (``Operation._in_cpp``); rows of its first result that are
            worth another thread, 0: one thread computes all.
    """
    return functools.partial(Operation, compiled=compiled, check=check, in_cpp=in_cpp)


@functools.cache
def operations() -> dict[str, Operation[..., Any]]:
    """Every operation by its name."""
    for path in build.OPS.glob("*/__init__.py"):
        importlib.import_module(f"mmpi_ns.ops.{path.parent.name}")
    return _OPERATIONS


def tensors_in(values: Iterable[Any]) -> Iterator[Tensor]:
    for x in values:
        if isinstance(x, Tensor):
            yield x
        elif isinstance(x, tuple):
            yield from tensors_in(x)


def form_of(name: str, *tensors: Tensor) -> Form:
    """The form for these tensors: a compiled one takes float32, integers and Adam's bfloat16 on one device."""
    compiled = operations()[name].compiled
    devices = {t.device.type for t in tensors}
    if _chosen == "torch" or any(t.is_floating_point() and t.dtype not in _PRECISIONS for t in tensors):
        return "reference"
    if devices == {"cpu"} and not interpreting:
        return "cpu" if "cpu" in compiled and fault("C++") is None else "reference"
    if devices == ({"cpu"} if interpreting else {"cuda"}) and "gpu" in compiled and fault(name) is None:
        return "gpu"
    return "reference"


@functools.cache
def function(name: str, form: Form) -> Any:
    """One form of an operation."""
    of = operations()[name]
    return getattr(of, form) if form != "gpu" else getattr(importlib.import_module(f"{of.__module__}.gpu"), name)


def choose(path: Route) -> None:
    """Sets the forms of the operations in this process. Raises InputError if ``native`` is asked for and an operation
    has no compiled form here (says why)."""
    global _chosen
    _chosen = path
    if path != "native":
        return
    on_gpu = torch.cuda.is_available() or interpreting
    names = ["Triton", *(n for n, each in operations().items() if "gpu" in each.compiled)] if on_gpu else ["C++"]
    if reason := next((r for n in names if (r := fault(n)) is not None), None):
        raise InputError(
            f"The compiled operations are not available ({reason}): use --pipeline.model.ops auto or torch."
        )


def expect(shapes: Shapes, afresh: bool = False) -> None:
    """Kernels that have not been tried with these shapes are, before they are used.

    Args:
        shapes: of the run at hand.
        afresh: also what passed on this device before.
    """
    global _shapes, _tries_afresh
    with _trying:
        if afresh or (shapes != _shapes and not interpreting):  # the interpreter would take minutes
            _shapes, _tries_afresh = shapes, afresh
            for name, each in operations().items():
                if "gpu" in each.compiled:
                    _faults.pop(name, None)
            _announce.cache_clear()


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
    try:  # the kernels with the shapes at hand, unless they passed before on this device
        trial = importlib.import_module("mmpi_ns.ops.trial")  # which tries operations, so it comes after this one
        record: Path | None = None if interpreting else trial.record(name, _shapes)
        if record is None:
            trial.run(name, "cpu", _shapes)
        elif _tries_afresh or not record.is_file():
            _announce()
            trial.run(name, "cuda", _shapes)
            record.parent.mkdir(parents=True, exist_ok=True)
            record.touch()
    except Exception as error:  # a driver, a compiler or a cache folder may fail in many ways: all mean plain torch
        headers = Path(sysconfig.get_paths()["include"]) / "Python.h"
        # Triton has a piece of C compiled for each kernel.
        if isinstance(error, RuntimeError) and "C compiler" in str(error):
            lacking = "Triton finds no C compiler: install gcc"
        elif isinstance(error, subprocess.CalledProcessError) and not headers.is_file():
            version = sysconfig.get_python_version()
            lacking = f"Triton needs Python's headers, and {headers} is missing: install python{version}-dev"
        elif isinstance(error, subprocess.CalledProcessError):
            compiler = Path(error.cmd[0]).name
            lacking = f"{compiler} cannot compile what starts Triton's kernels; its words are above"
        else:
            words = f"{type(error).__name__}: {brief(error)[:200]}"
            return _say(f"its Triton kernel fails on this device ({words})", f"Plain torch for {name}")
        _faults["Triton"] = _say(lacking)  # no other kernel will do better
        return lacking
    return None


@functools.cache
def _announce() -> None:
    CONSOLE.print(f"Compiling kernels for {torch.cuda.get_device_name()}: about a minute, once.")


def _say(reason: str, instead: str = "Plain torch instead of the compiled operations") -> str:
    say(f"{instead}, several times slower: {reason}.")
    return reason
