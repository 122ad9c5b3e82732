"""Compiles the Triton kernels for a GPU that is not there: every launch becomes a compilation for its arguments."""

from __future__ import annotations

import importlib
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

import torch
import triton
from random_fields import random_field
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from mmpi_ns.field.color_network import ColorNetworks
from mmpi_ns.ops import dispatch, trial, triton_shade

TARGET = GPUTarget("cuda", 90, 32)
NAMES = {
    torch.float32: "*fp32",
    torch.int64: "*i64",
    torch.int32: "*i32",
    torch.uint8: "*u8",
    torch.bool: "*i1",
}


def _type(value):
    if isinstance(value, torch.Tensor):
        return NAMES[value.dtype]
    return "fp32" if isinstance(value, float) else "i64" if abs(value) >= 2**31 else "i32"


@contextmanager
def compiling(made):
    """Within, a launch compiles its kernel into ``made`` [(kernel's name, constants) -> compiled] and runs nothing.

    What a launch would have read or written is zeroed, so that callers who size arrays by it go on.
    """
    run = triton.runtime.JITFunction.run

    def compile_instead(self, *args, grid, warmup, num_warps=4, **constants):
        del grid, warmup
        given = dict(zip(self.arg_names, args, strict=False))
        # As a launch does: an integer of 1 becomes a constant.
        constants |= {name: 1 for name, value in given.items() if type(value) is int and value == 1}
        signature = {name: _type(value) for name, value in given.items()}
        signature |= {name: "constexpr" for name in constants}
        key = (self.fn.__name__, tuple(sorted(constants.items())), tuple(signature.values()))
        if key not in made:
            source = ASTSource(self, signature=signature, constexprs=constants)
            made[key] = triton.compile(source, target=TARGET, options={"num_warps": num_warps})
        for value in args:
            if isinstance(value, torch.Tensor):
                value.zero_()

    triton.runtime.JITFunction.run = compile_instead
    try:
        yield made
    finally:
        triton.runtime.JITFunction.run = run


def resources(kernel):
    """What the disassembler says that a compiled kernel needs; registers that do not fit go to its stack."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        return subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True, check=True).stdout


def launches(monkeypatch):
    """Launches every kernel as on a GPU: with the arguments of the trials."""
    for name, cases in trial.CASES.items():
        folder = dispatch.TABLE[name][0]
        module = triton_shade if name == "shade" else importlib.import_module(f"mmpi_ns.ops.{folder}.gpu")
        if hasattr(module, "block_size"):  # arrays on a CPU, but blocks of a GPU's size
            monkeypatch.setattr(module, "block_size", lambda wanted, device: wanted)
        for given in cases("cpu"):
            trial._outcome(name, "gpu", given)
    networks, grid = ColorNetworks(3, 9, 64, 2, 2), torch.arange(60).view(20, 3)
    layout, rays, places = random_field(2, True, seed=1).layout, torch.zeros(3, 20, 3), torch.zeros(20, 3, 3)
    monkeypatch.setattr(torch.Tensor, "tolist", lambda self: [0, 20, 40, 60])
    triton_shade.shade(layout, torch.zeros(7, 9), networks, rays, grid, grid, places, grid >= 0)
