"""Tries an operation's GPU form on a toy scene: on the current device it must agree with the reference.

This also compiles the kernels, so that an incompatible Triton release, driver or architecture is noticed here and not
in the first step of a training.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops.adam import AdamConstants
from mmpi_ns.ops.gather import Taps
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import MarchOptions, Rays
from mmpi_ns.scene.geometry import Cube, Frames
from mmpi_ns.scene.plan import CubePlan, MPIPlan
from mmpi_ns.scene.texels import BRICK, make_grids

CLOSE = 1e-3
"""Largest difference relative to the largest number: a wrong kernel is off by more, another order of sums by less."""
FEW = 1e-3
"""Share of numbers that may differ: two samples at nearly one distance, or half of a ray's mass at nearly one sample,
come out either way. Of forty rays none may."""
RAYS, CHANNELS, ROWS = 40, 9, 300
MANY_RAYS = 1 << 14
"""From so many on the march takes larger blocks."""
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Disagreement(Exception):
    """A kernel ran and disagrees with its reference."""


def run(name: str, device: str) -> None:
    """Tries one operation on a device.

    Raises:
        Exception: whatever Triton, its compiler or the driver finds amiss.
        Disagreement: the results differ.
    """
    for arguments in CASES[name](device):
        kernel = _outcome(name, "gpu", arguments)
        with dispatch.chosen("torch"):
            reference = _outcome(name, "reference", arguments)
        for a, b in zip(kernel, reference, strict=True):
            if a.shape != b.shape:
                raise Disagreement(f"it makes {list(a.shape)} numbers where plain torch makes {list(b.shape)}")
            # Numbers of a type with few digits may be rounded up or down.
            close = max(CLOSE, torch.finfo(b.dtype).eps if b.is_floating_point() else 0.0)
            a, b = a.double(), b.double()
            off = ~((a - b).abs() <= close * b.abs().max().clamp(min=1e-6)) if b.numel() else b
            if off.numel() and (share := float(off.double().mean())) > FEW:
                raise Disagreement(f"{share:.2g} of its numbers are not those of plain torch")


def _outcome(name: str, form: dispatch.Form, arguments: tuple) -> list[Tensor]:
    """All numbers that come of an operation, and its gradients where it has them."""
    copies = tuple(x.detach().clone() if isinstance(x, Tensor) else x for x in arguments)
    leaves = [
        c.requires_grad_() for c, x in zip(copies, arguments, strict=True) if isinstance(x, Tensor) and x.requires_grad
    ]
    taps = [t for x in copies if isinstance(x, list) for t in x if isinstance(t, Taps)]
    leaves += [t.weights for t in taps if t.weights.requires_grad]
    with torch.set_grad_enabled(bool(leaves)):
        results = dispatch.function(name, form)(*copies)
    numbers = _numbers(copies if results is None else results)
    if leaves:
        loss = sum((x * torch.linspace(-1, 1, x.numel(), device=x.device).view(x.shape)).sum() for x in numbers)
        numbers += list(torch.autograd.grad(loss, leaves))  # type: ignore[arg-type]
    return [x.detach() for x in numbers]


def _numbers(results: Any) -> list[Tensor]:
    if isinstance(results, Tensor):
        return [results]
    parts = [getattr(results, f.name) for f in fields(results)] if is_dataclass(results) else results
    return [x for part in parts if isinstance(part, Tensor | tuple) for x in _numbers(part)]


# Toy inputs ----------------------------------------------------------------------------------------------------------


def _random(device: str, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(sum(shape))).to(device)


def _scene(device: str, with_cube: bool) -> tuple[SceneLayout, Tables]:
    """Two thin MPIs that face the same way, with all texels stored, and a cube among their planes."""
    mpis = tuple(
        MPIPlan(str(k), (0.31 * k, 0.0, -0.53 * k), AXES, 1.0, (-1.0, 1.0, -0.8, 0.8), 6, 9, 11) for k in range(2)
    )
    shapes, cube = [(m.planes, m.height, m.width) for m in mpis], None
    if with_cube:
        plan = CubePlan((-1.1, -0.9, 1.9), (0.95, 1.05, 4.3), (4, 5, 6))
        shapes, cube = [*shapes, plan.shape], Cube.pack(plan, 1.0, device=device)
    tiles = torch.arange(1, make_grids(shapes)[0].tiles.numel() + 1, dtype=torch.int32)
    grids = make_grids(shapes, tiles.to(device))
    frames, rows = Frames.pack(mpis, device=device), len(grids[0].places) * BRICK
    biases = [torch.full((m.planes,), -5.0, device=device) for m in mpis]
    layout = SceneLayout(mpis, frames, grids, biases, 1.0, cube, -5.0, 1.0)
    touched = (_random(device, rows) > 0.2).to(torch.uint8)
    return layout, Tables(_random(device, rows, 1) - 0.5, _random(device, rows, 1), touched)


def _rays(device: str, count: int = RAYS) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Origins, directions, nears and fars."""
    origins = _random(device, count, 3) * 0.4 - 0.2
    directions = torch.cat([_random(device, count, 2) - 0.5, torch.ones(count, 1, device=device)], -1)
    near = torch.full((count, 1), 0.05, device=device)
    return origins, torch.nn.functional.normalize(directions, dim=-1), near, torch.full_like(near, torch.inf)


def _marches(device: str, many: bool | None = None) -> list[tuple]:
    """Also of many rays where the kernels do not take minutes for them, by Triton's interpreter."""
    many, cases = device == "cuda" if many is None else many, []
    for with_cube, options, count in (
        (True, MarchOptions(0.0), RAYS),
        (True, MarchOptions(0.01, blends=True), RAYS),
        (False, MarchOptions(0.01), RAYS),
        # All are kept: some sample would weigh what the threshold says.
        *([(True, MarchOptions(0.0, blends=True), MANY_RAYS)] if many else []),
    ):
        layout, tables = _scene(device, with_cube)
        cases.append((layout, tables, Rays(*_rays(device, count)), options))
    return cases


def _entries(device: str, *shape: int) -> Tensor:
    """Rows of a table of ``ROWS``, many of them several times."""
    return (_random(device, *shape) * (ROWS // 3)).long() * 3


def _variations(device: str) -> list[tuple]:
    layout = _scene(device, True)[0]
    table = 3 * _random(device, len(layout.grids[0].places) * BRICK, CHANNELS)
    rows = torch.cat([grid.rows for grid in layout.grids])[::3]
    return [(table[rows].requires_grad_(), table, rows, layout, [(0.5, 2.0, 1.0)] * layout.num_heads)]


def _adams(device: str) -> list[tuple]:
    moments, grad = _random(device, ROWS, 2, CHANNELS), _random(device, ROWS // 3, CHANNELS) - 0.5
    step = (
        3 * torch.arange(ROWS // 3, device=device),
        grad * (grad.abs() > 0.1),
        AdamConstants(0.9, 0.99, 0.2, 1e-8, 0.1),
    )
    return [(_random(device, ROWS, CHANNELS), m, *step) for m in (moments, moments.bfloat16())]


def _gathers(device: str) -> list[tuple]:
    """Samples with known texels, of planes and of both planes and the cube, that move and that do not; texels with
    gradients and without."""
    weights, chosen = 0.1 * _random(device, RAYS, 4), torch.arange(RAYS, device=device) % 5 > 0
    cases, both = [], (4, 8)
    for sizes, learns, moves in (((4,), True, False), (both, False, False), (both, True, False), (both, True, True)):
        shares = [(_random(device, RAYS, n) / n).requires_grad_(moves) for n in sizes]
        taps = [Taps(_entries(device, RAYS, x.shape[1]).int(), x) for x in shares]
        slots = torch.cat([4 * torch.arange(RAYS, device=device) + i for i in range(len(sizes))])
        values = (2 * _random(device, ROWS, CHANNELS) - 1).requires_grad_(learns)
        cases.append((values, taps, slots, weights.clone().requires_grad_(), chosen))
    return cases


def _pictures(device: str, many: bool | None = None) -> list[tuple]:
    return [
        (layout, tables, 2 * _random(device, len(tables.density), CHANNELS) - 1, *how)
        for layout, tables, *how in _marches(device, many)
    ]


CASES: dict[str, Callable[[str], list[tuple]]] = {
    "march": _marches,
    "texel_rows": lambda device: [
        (
            _scene(device, True)[0],
            heads := (torch.arange(RAYS, device=device) * 2) // RAYS,
            heads + 2,
            2 * _random(device, RAYS, 3) - 1,
        )
    ],
    "weighted_rows": lambda device: [
        (_random(device, ROWS, CHANNELS), _entries(device, RAYS, taps), _random(device, RAYS, taps)) for taps in (4, 8)
    ],
    "index_rows": lambda device: [(_entries(device, RAYS, 4), ROWS, False)],
    "sum_rows": lambda device: [
        (_entries(device, RAYS, 4).int(), _random(device, RAYS, CHANNELS), _random(device, RAYS, 4), ROWS)
    ],
    "composite_weights": lambda device: [
        (
            (_random(device, RAYS, 20) ** 3).requires_grad_(),
            torch.arange(20, device=device) < _entries(device, RAYS, 1),
            0.01 * _random(device, RAYS, 20),
            _random(device, RAYS, 1),
        )
    ],
    "total_variation": _variations,
    "adam_rows": _adams,
    "gather_taps": _gathers,
    "show_rays": _pictures,
}
"""Arguments for every operation that has a GPU form."""
