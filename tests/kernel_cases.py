"""Toy arguments for every operation that has a GPU form, and the comparison of its forms on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from mmpi_ns.ops import dispatch
from mmpi_ns.ops import variation as variation
from mmpi_ns.ops.adam import AdamConstants
from mmpi_ns.ops.gather import Taps
from mmpi_ns.ops.layout import SceneLayout, Tables
from mmpi_ns.ops.march import MarchOptions, Rays
from mmpi_ns.scene.geometry import Cube, Frames
from mmpi_ns.scene.plan import CubePlan, MPIPlan
from mmpi_ns.scene.texels import BRICK, make_grids
from mmpi_ns.training import losses as losses

CLOSE = 1e-3
"""Largest difference relative to the largest number: a wrong kernel is off by more, another order of sums by less."""
RAYS, ROWS = 40, 300
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Shapes(NamedTuple):
    """What kernels are compiled for in a run."""

    mpis: tuple[int, ...] = (2,)
    cube: bool = True
    blends: bool = True
    channels: int = 8


SMALL = Shapes()


def differences(name: str, device: str, shapes: Shapes = SMALL) -> list[float]:
    """Of the GPU form of an operation and its definition, relative to the largest number, for each case."""
    actual = []
    for arguments in CASES[name](device, shapes):
        kernel = _outcome(name, "gpu", arguments)
        with dispatch.chosen("torch"):
            reference = _outcome(name, "reference", arguments)
        for a, b in zip(kernel, reference, strict=True):
            finite = b.double().isfinite()
            assert a.shape == b.shape and torch.equal(a[~finite], b[~finite]), name
            if finite.any():
                a, b = a[finite].double(), b[finite].double()
                actual.append(float((a - b).abs().max() / b.abs().max().clamp(min=1e-6)))
                assert actual[-1] >= 0, f"{name}: not a number"
    return actual


def _outcome(name: str, form: dispatch.Form, arguments: tuple) -> list[Tensor]:
    """All numbers that come of an operation, and its gradients where it has them."""
    copies = tuple(x.detach().clone() if isinstance(x, Tensor) else x for x in arguments)
    leaves = [
        c.requires_grad_() for c, x in zip(copies, arguments, strict=True) if isinstance(x, Tensor) and x.requires_grad
    ]
    leaves += [x.weights for x in copies if isinstance(x, Taps) and x.weights.requires_grad]
    with torch.set_grad_enabled(bool(leaves)):
        results = dispatch.function(name, form)(*copies)
    numbers = [*dispatch.tensors_in(vars(results).values() if is_dataclass(results) else [results])]
    numbers += [copies[i] for i in CHANGED.get(name, ())]
    if leaves:
        loss = sum((x * torch.linspace(-1, 1, x.numel(), device=x.device).view(x.shape)).sum() for x in numbers)
        numbers += list(torch.autograd.grad(loss, leaves))  # type: ignore[arg-type]
    return [x.detach() for x in numbers]


def _random(device: str, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(sum(shape))).to(device)


def _scene(device: str, with_cube: bool, count: int = 2) -> tuple[SceneLayout, Tables]:
    """Thin MPIs that face the same way, with all texels stored, and a cube among their planes."""
    places = ((0.31 * (k % 5), 0.003 * k, -0.53 * (k % 7) - 0.0137 * (k // 7)) for k in range(count))
    mpis = tuple(MPIPlan(str(k), place, AXES, 1.0, (-1.0, 1.0, -0.8, 0.8), 6, 9, 11) for k, place in enumerate(places))
    sizes, cube = [(m.planes, m.height, m.width) for m in mpis], None
    if with_cube:
        plan = CubePlan((-1.1, -0.9, 1.9), (0.95, 1.05, 4.3), (4, 5, 6))
        sizes, cube = [*sizes, plan.shape], Cube.pack(plan, 1.0, device=device)
    grids = make_grids(sizes, make_grids(sizes)[0].tiles.to(device), with_cube)
    frames, rows = Frames.pack(mpis, device=device), len(grids[0].places) * BRICK
    biases = [torch.full((m.planes,), -5.0, device=device) for m in mpis]
    layout = SceneLayout(mpis, frames, grids, biases, min(1.0, 2 / count), cube, -5.0, 1.0, 0.7)  # not opaque
    touched = (_random(device, rows) > 0.2).to(torch.uint8)
    return layout, Tables(_random(device, rows, 1) - 0.5, _random(device, rows, 1), touched)


def _marches(device: str, shapes: Shapes, shows: bool = False) -> list[tuple]:
    """Of the march, or of pictures, which also take features."""
    cases, near = [], torch.full((RAYS, 1), 0.05, device=device)
    ahead = torch.cat([_random(device, RAYS, 2) - 0.5, torch.ones(RAYS, 1, device=device)], -1)
    directions = torch.nn.functional.normalize(ahead, dim=-1)
    rays = Rays(_random(device, RAYS, 3) * 0.4 - 0.2, directions, near, torch.full_like(near, torch.inf))
    for mpis in shapes.mpis:
        some, every = MarchOptions(0.02 / max(mpis, 2)), MarchOptions(0.0)
        layout, tables = _scene(device, shapes.cube, mpis)
        scene = (layout, tables, 2 * _random(device, len(tables.density), shapes.channels) - 1)[: 3 if shows else 2]
        cases += [(*scene, rays, options) for options in (some, every)]
        if shapes.blends:
            cases.append((*scene, rays, some._replace(blends=True)))
            # Before that, each MPI answers rays of its own.
            for which in ((_random(device, RAYS, layout.num_heads) < 0.5, None), (None, _random(device, RAYS, mpis))):
                cases.append((*scene, Rays(*rays[:4], *which), some))
    return cases


def _variations(device: str, shapes: Shapes) -> list[tuple]:
    cases = []
    for mpis in shapes.mpis:
        layout = _scene(device, shapes.cube, mpis)[0]
        rows = torch.cat([grid.rows for grid in layout.grids])[::3]
        for channels in (1, shapes.channels):
            table = 3 * _random(device, len(layout.grids[0].places) * BRICK, channels)
            scales = torch.tensor([(0.5, 2.0, 1.0)] * layout.num_heads, device=device)
            cases.append((table[rows].requires_grad_(), table, rows, layout, scales, 3.0 * (channels > 1)))
    return cases


def _gathers(device: str, shapes: Shapes) -> list[tuple]:
    """Samples with known texels, without and with a cube, that move and that do not, and three that belong to no ray;
    texels with gradients and without."""
    counts, chosen = torch.arange(RAYS, device=device) % 4, torch.arange(RAYS, device=device) % 5 > 0
    starts, cases = torch.nn.functional.pad(counts.cumsum(0), (1, 0)), []
    count = int(starts[-1]) + 3
    for taps, learns, moves in ((4, True, False), (8, False, False), (8, True, False), (8, True, True)):
        shares = (_random(device, count, taps) / taps).requires_grad_(moves)
        # Some rows of the table, many of them several times.
        rows = (_random(device, count, taps) * (ROWS // 3)).int() * 3
        values = (2 * _random(device, ROWS, shapes.channels) - 1).requires_grad_(learns)
        weights = (0.1 * _random(device, count)).requires_grad_()
        cases.append((values, Taps(rows, shares), starts, weights, None if learns and not moves else chosen))
    return cases


def _updates(device: str, shapes: Shapes) -> list[tuple]:
    rows = torch.arange(BRICK, BRICK + 2 * ROWS, 2, device=device)
    cases = []
    for channels in (1, shapes.channels):
        table, grad = _random(device, BRICK + 2 * ROWS, channels), _random(device, ROWS, channels) - 0.5
        moments = _random(device, len(table), 2, channels).bfloat16()
        cases.append((table, moments, rows, grad, AdamConstants(0.9, 0.99, 0.3, 1e-8, 0.1)))
    network, grad = _random(device, 2, ROWS), (_random(device, 2, ROWS, 1)[..., 0] - 0.5).clamp(min=0)
    return [*cases, (network, _random(device, 2, 2, ROWS), None, grad, cases[0][-1])]


def _votes(device: str, shapes: Shapes) -> list[tuple]:
    """Samples of each head inside and outside of it, some at infinity, behind the MPIs and along their planes."""
    cases, ways = [], [(0.3, -0.2, 1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.1, 0.0, -1.0)]
    directions = torch.tensor(ways, device=device).repeat(2 * RAYS, 1)
    for mpis in shapes.mpis:
        layout, tables = _scene(device, shapes.cube, mpis)
        heads, inverse_t = torch.arange(8 * RAYS, device=device) % layout.num_heads, _random(device, 8 * RAYS)
        samples = (_random(device, 8 * RAYS, 3) * 0.4 - 0.2, directions, inverse_t * (inverse_t > 0.1))
        cases += [(layout, tables, *(x[:count] for x in (*samples, heads))) for count in (0, len(heads))]
    return cases


def _rays_of_samples(device: str) -> tuple[Tensor, Tensor]:
    """Optical depths of samples, a tenth of them opaque, and the first of each ray; some rays are without, and three
    samples belong to none."""
    starts = torch.nn.functional.pad((torch.arange(RAYS, device=device) % 7).cumsum(0), (1, 0))
    tau = _random(device, int(starts[-1]) + 3)
    return torch.where(tau > 0.9, 500 * tau, tau), starts


def _composites(device: str, shapes: Shapes) -> list[tuple]:
    tau, starts = _rays_of_samples(device)
    before, total = 0.1 * _random(device, len(tau)), 0.3 * _random(device, RAYS, 1)
    return [(tau.requires_grad_(), starts, before, total)]


def _depths(device: str, shapes: Shapes) -> list[tuple]:
    """Inverse distances that fall along rays, a third of which have no target."""
    tau, starts = _rays_of_samples(device)
    inverse_t = torch.linspace(1, 0, len(tau), device=device)
    targets = _random(device, RAYS, 2) * (torch.arange(RAYS, device=device) % 3 > 0)[:, None] + 1e-3
    weights = (0.1 * _random(device, len(tau))).index_fill(0, torch.arange(int(starts[-1]), len(tau), device=device), 0)
    return [(weights.requires_grad_(), inverse_t, starts, 0.1 * _random(device, RAYS), targets, 1.3)]


def _losses(device: str, shapes: Shapes) -> list[tuple]:
    """Two MPIs' pixel rays and keypoint rays, colours with alpha and exposures that clip; pixel rays alone."""
    cases = []
    for asked, times, channels in ((RAYS // 4, 2, 4), (RAYS, 1, 3)):
        values = [_random(device, RAYS, n).squeeze(-1) for n in (3, 2, 2, 4, 5, 1, 1)]
        transmittance = values[1][:, :1].masked_fill(values[1][:, 1:] < 0.2, 0.0)
        given = [values[0], transmittance, values[2][:, :1], values[3][:, :3], values[4][:, :3], values[5], values[6]]
        leaves = [x.contiguous().requires_grad_(i != 2) for i, x in enumerate(given)]
        flags = values[5] > 0.3, values[6][:, None] > 0.5, 2 * _random(device, RAYS, 3) if channels == 4 else None
        pixels = _random(device, asked, channels), _random(device, asked * times, 3)
        cases.append((*leaves, *flags, *pixels, times, (0.3, 0.2, 0.1, 0.4, 0.7), 0.5, True))
    return cases


def _targets(device: str, shapes: Shapes) -> list[tuple]:
    depths, counts = _random(device, RAYS, 2), torch.arange(RAYS, device=device)
    keypoints = _random(device, RAYS, 1) * (counts % 2)[:, None]
    return [(depths, keypoints, counts, 0.1), (None, keypoints, counts, 0.1), (depths, None, counts, 0.1)]


def _shader_inputs(device: str, shapes: Shapes) -> list[tuple]:
    """Rays with more and with almost no weight."""
    mass = _random(device, RAYS, 1) * (_random(device, RAYS, 2)[:, :1] > 0.3) + 1e-7
    directions = torch.nn.functional.normalize(_random(device, RAYS, 3) - 0.5, dim=-1)
    gathered = mass * _random(device, RAYS, shapes.channels)
    return [(gathered.requires_grad_(), mass.clone().requires_grad_(), directions, octaves) for octaves in (2, 0)]


def _shaded(device: str, shapes: Shapes) -> list[tuple]:
    values = _random(device, RAYS, shapes.channels + 15), 4 * _random(device, RAYS, 3) - 2, _random(device, RAYS, 1)
    return [tuple(x.requires_grad_() for x in values)]


def _shares(device: str, shapes: Shapes) -> list[tuple]:
    """Heads that alone cover a sample, and reliabilities of all sizes."""
    cases = []
    for heads in shapes.mpis:
        own = torch.arange(8 * RAYS, device=device) % heads
        covers = (_random(device, 8 * RAYS, heads) > 0.6) | (torch.arange(heads, device=device) == own[:, None])
        cases.append(((9 * _random(device, 8 * RAYS, heads) - 3).requires_grad_(), covers, own))
    return cases


def _depths_to_blend(device: str, shapes: Shapes) -> list[tuple]:
    """Thin and opaque samples, of small and of large shares, and of sole heads."""
    share, tau = 0.98 * _random(device, 8 * RAYS) + 0.01, 4 * _random(device, 8 * RAYS, 1)[:, 0] ** 3
    sole = torch.arange(8 * RAYS, device=device) % 5 == 0
    log_share, log_rest = share.log().masked_fill(sole, 0), (1 - share).log().masked_fill(sole, -torch.inf)
    return [(tau.requires_grad_(), log_share.requires_grad_(), log_rest.requires_grad_())]


def _lookups(device: str, shapes: Shapes) -> list[tuple]:
    """Samples of every head, some beyond its borders."""
    cases = []
    for mpis in shapes.mpis:
        layout = _scene(device, shapes.cube, mpis)[0]
        number = torch.arange(8 * RAYS, device=device)
        samples = (layout, number % layout.num_heads, number % 6, 2.4 * _random(device, len(number), 3) - 1.2)
        cases += [(*samples, None), (*samples, torch.tensor([7 * RAYS], device=device))]
    return cases


CHANGED = {"adam_rows": (0, 1)}
"""Arguments that an operation changes."""
CASES: dict[str, Callable[[str, Shapes], list[tuple]]] = {
    "adam_rows": _updates,
    "blend_shares": _shares,
    "blended_optical_depth": _depths_to_blend,
    "composite_weights": _composites,
    "depth_sums": _depths,
    "depth_targets": _targets,
    "ray_losses": _losses,
    "shader_inputs": _shader_inputs,
    "shaded": _shaded,
    "texel_rows": _lookups,
    "find_votes": _votes,
    "march": _marches,
    "total_variation": _variations,
    "gather_taps": _gathers,
    "render_fused": partial(_marches, shows=True),
}
"""Arguments for every operation that has a GPU form."""
