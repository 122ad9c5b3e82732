"""Compiles the Triton kernels for a GPU that is not there: every launch becomes a compilation for its arguments."""

from __future__ import annotations

import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

import torch
import triton
from random_fields import bundle, random_field, random_rays
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from mmpi_ns.field.color_network import ColorNetworks
from mmpi_ns.ops import triton_composite, triton_march, triton_shade, triton_tables
from mmpi_ns.ops.gather import KnownTaps
from mmpi_ns.ops.gather import gpu as gather_gpu
from mmpi_ns.rendering.sampler import MMPISampler

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
    """Launches every kernel as on a GPU."""
    for module in (triton_march, triton_tables, gather_gpu):
        monkeypatch.setattr(module, "block_size", lambda wanted, device: wanted)
    for num_mpis, with_cube, form, count in ((4, False, None, 20), (2, True, "paper", 1)):
        field = random_field(num_mpis, with_cube, seed=1)
        rays = bundle(*random_rays(field.plan, count, seed=1))
        for shares in (None, field.density.data) if form else (None,):
            MMPISampler()(rays, field=field, threshold=1e-3, blend_form=form, shares=shares)
    number = torch.zeros(50, dtype=torch.int64)
    rows, weights, values, table = (
        number[:, None].repeat(1, 4),
        torch.zeros(50, 4),
        torch.zeros(50, 9),
        torch.zeros(7, 9),
    )
    triton_tables.interpolate(table, rows, weights)
    triton_tables.interpolate(table[:, :1].contiguous(), rows.int(), weights)
    triton_tables.sum_by_position(rows.int(), values, weights, 3)
    triton_tables.sum_by_position(rows.int()[:, :1], values, None, 3)
    triton_tables.index_rows(rows)
    triton_tables.adam_rows(table, table.clone(), table.clone(), number, values, (0.9, 0.99, 0.1, 1e-8, 0.1))
    triton_tables.Variation.apply(values, table, number, torch.zeros(3, 5, dtype=torch.int64), torch.zeros(3, 3))
    scene = random_field(2, True, seed=1).triton_scene()[0]
    for in_cube in (False, True):
        triton_tables.taps(scene, number, number, torch.zeros(50, 3), in_cube)
    everything = torch.ones(10, dtype=torch.bool)
    for taps in ([4], [8], [4, 8]):
        own = [KnownTaps(number[:20, None].repeat(1, n).int(), torch.zeros(20, n)) for n in taps]
        slots, weights_of_rays = number[: 20 * len(taps)], torch.zeros(10, 5, requires_grad=True)
        for channels in (9, 20):
            read = torch.zeros(7, channels, requires_grad=True)
            for texels in (read, read.detach()):
                gather_gpu.gather_taps(texels, own, slots, weights_of_rays, everything).gathered.sum().backward()
    places = (number.view(10, 5), number.view(10, 5), torch.zeros(10, 5, 3), number.view(10, 5) >= 0)
    for with_cube in (False, True):
        there = random_field(2, with_cube, seed=1).triton_scene()[0]
        gather_gpu.gather_places(there, table, *places, torch.zeros(10, 5))
    networks, grid = ColorNetworks(3, 9, 64, 2, 2), torch.arange(60).view(20, 3)
    with monkeypatch.context() as edges:
        edges.setattr(torch.Tensor, "tolist", lambda self: [0, 20, 40, 60])
        rays, places = torch.zeros(3, 20, 3), torch.zeros(20, 3, 3)
        triton_shade.shade(scene, table, networks, rays, grid, grid, places, grid >= 0)
    for shape in ((20, 40), (1, 1)):
        tau = torch.zeros(*shape, requires_grad=True)
        made = triton_composite.composite_weights(tau, tau >= 0, torch.zeros(*shape), torch.zeros(shape[0], 1))
        made.weights.sum().backward()
