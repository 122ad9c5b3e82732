"""Compiles the Triton kernels for a GPU that is not there: every launch becomes a compilation for its arguments."""

from __future__ import annotations

from contextlib import contextmanager

import torch
import triton
from random_fields import bundle, random_field, random_rays
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from mmpi_ns.mmpi_sampler import MMPISampler
from mmpi_ns.ops import triton_composite, triton_march, triton_tables

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
        signature = {name: _type(value) for name, value in zip(self.arg_names, args, strict=False)}
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


def launches(monkeypatch):
    """Launches every kernel as on a GPU."""
    for module in (triton_march, triton_tables):
        monkeypatch.setattr(module, "block_size", lambda wanted, device: wanted)
    for num_mpis, with_cube, form in ((4, False, None), (2, True, "paper")):
        field = random_field(num_mpis, with_cube, seed=1)
        rays = bundle(*random_rays(field.plan, 20, seed=1))
        MMPISampler()(rays, field=field, threshold=1e-3, blend_form=form)
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
    tau = torch.zeros(20, 40, requires_grad=True)
    made = triton_composite.composite_weights(tau, tau >= 0, torch.zeros(20, 40), torch.zeros(20, 1))
    made.weights.sum().backward()
