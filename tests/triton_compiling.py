"""Compiles the Triton kernels for GPUs that are not there: every launch becomes a compilation for its arguments.

To try another release of Triton, put it on the path before the installed one and run ``tests/ops/test_gpu.py``:

    pip install --no-deps --target triton-3.1 triton==3.1.0
"""

from __future__ import annotations

import importlib
import subprocess
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import kernel_cases
import torch
import triton
from kernel_cases import SMALL
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from mmpi_ns.ops import dispatch

NAMES = {
    torch.float32: "*fp32",
    torch.bfloat16: "*bf16",
    torch.int16: "*i16",
    torch.int64: "*i64",
    torch.int32: "*i32",
    torch.uint8: "*u8",
    torch.bool: "*i1",
}
TAKES_CONSTEXPRS = tuple(int(n) for n in triton.__version__.split(".")[:2]) >= (3, 3)
"""Whether a signature lists the constants too."""


@dataclass(frozen=True)
class Launch:
    """A kernel with the types of its arguments and its constants."""

    kernel: triton.runtime.JITFunction
    signature: tuple[tuple[str, str], ...]
    constants: tuple[tuple[str, object], ...]
    num_warps: int

    @property
    def name(self):
        return self.kernel.fn.__name__

    def compiled(self, architecture):
        signature, constants = dict(self.signature), dict(self.constants)
        if TAKES_CONSTEXPRS:
            signature |= dict.fromkeys(constants, "constexpr")
            source = ASTSource(self.kernel, signature=signature, constexprs=constants)
        else:
            source = ASTSource(self.kernel, signature=signature, constants=constants)
        target = GPUTarget("cuda", architecture, 32)
        return triton.compile(source, target=target, options={"num_warps": self.num_warps})


def _type(value):
    if isinstance(value, torch.Tensor):
        return NAMES[value.dtype]
    return "fp32" if isinstance(value, float) else "i64" if abs(value) >= 2**31 else "i32"


@contextmanager
def launches_noted(noted):
    """Within, a launch is added to ``noted`` (a dict, for its order) and runs nothing.

    What it would have read or written is zeroed, so that callers who size arrays by it go on.
    """
    run = triton.runtime.JITFunction.run

    def note(self, *args, grid, warmup, num_warps=4, **constants):
        del grid, warmup
        given = dict(zip(self.arg_names, args, strict=False))
        # As a launch does: an integer of 1 becomes a constant.
        ones = {n: 1 for n, v in given.items() if type(v) is int and v == 1 and n not in self.do_not_specialize}
        given = {name: _type(value) for name, value in given.items() if name not in ones}
        constants |= ones
        noted[Launch(self, tuple(given.items()), tuple(constants.items()), num_warps)] = None
        for value in args:
            if isinstance(value, torch.Tensor):
                value.detach().zero_()

    triton.runtime.JITFunction.run = note
    try:
        yield noted
    finally:
        triton.runtime.JITFunction.run = run


def all_launches(setattr, shapes=SMALL):
    """Every kernel launched as on a GPU, with toy arguments.

    Args:
        shapes: of the toy scenes.
        setattr: sets an attribute of an object, for as long as the launches are used.
    """
    setattr(dispatch, "interpreting", True)
    setattr(dispatch, "fault", lambda *_: None)
    with launches_noted({}) as noted:
        for name, cases in kernel_cases.CASES.items():
            module = importlib.import_module(f"{dispatch.OPERATIONS[name].kernels}.gpu")
            if hasattr(module, "block_size"):  # arrays on a CPU, but blocks of a GPU's size
                setattr(module, "block_size", lambda wanted, device: wanted)
            for given in cases("cpu", shapes):
                kernel_cases._outcome(name, "gpu", given)
    return list(noted)


def largest_launches(launches):
    """Of each kernel the launch with the most in it."""
    largest = {}
    for launch in launches:
        constants = dict(launch.constants)
        # What keeps all samples passes over no empty tiles.
        size = sum(int(value) for value in constants.values()) - 2 * constants.get("KEEP_ALL", False)
        if launch.name not in largest or size > largest[launch.name][0]:
            largest[launch.name] = size, launch
    return {name: launch for name, (_, launch) in largest.items()}


def resources(kernel):
    """What the disassembler says that a compiled kernel needs; registers that do not fit go to its stack."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        return subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True, check=True).stdout


def spills(kernel):
    """Whether registers of a compiled kernel go to memory. A stack alone, of a few bytes, says nothing where the kernel
    does not take all registers that there are."""
    actual = resources(kernel)
    return "STACK:0" not in actual and "REG:255" in actual
