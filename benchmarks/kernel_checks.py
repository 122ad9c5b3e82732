"""Correctness on the device: every Triton kernel against float64, before anything is timed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from random_scenes import CUBE, Scene, dense_grad, gradients_of, of_rays, random_scene, samples_of
from torch import Tensor

from mmpi_ns.ops import dispatch, interpolate, variation
from mmpi_ns.scene.plan import CubePlan
from mmpi_ns.training.touched_adam import TouchedAdam


@dataclass(frozen=True)
class Check:
    """One comparison with float64."""

    name: str
    error: float
    """Largest difference, relative to the largest number compared; or how many things are wrong."""
    bound: float

    @property
    def ok(self) -> bool:
        return self.error <= self.bound


def _relative(actual: Any, expected: Any) -> float:
    """Largest difference relative to the largest expected number; infinite where something is not finite."""
    actual, expected = (torch.as_tensor(x).detach().double().cpu() for x in (actual, expected))
    if actual.shape != expected.shape or not bool(torch.isfinite(actual).all()):
        return float("inf")
    return float((actual - expected).abs().max() / expected.abs().max().clamp(min=1e-12)) if expected.numel() else 0.0


def _draw(device: str, *shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).to(device)


# Whole rays ----------------------------------------------------------------------------------------------------------


def whole_rays(s: Scene, name: str, device: str) -> list[Check]:
    """March, interpolation and compositing together, values and gradients, against plain torch in float64."""
    s = s.clear()
    exact, by = s.exact(), np.random.default_rng(0).normal(size=(len(s.bundle), 3))
    expected = exact.render()
    slopes = gradients_of(exact.field, expected, by)
    s.field.to(device)
    actual = s.render()
    gradients = gradients_of(s.field, actual, by)
    with torch.no_grad():
        shaded = s.render().rgb
    wrong = sum(a != b for a, b in zip(samples_of(actual)[0], samples_of(expected)[0], strict=True))
    return [
        *marched(s, name, exact),
        Check(f"{name}: rays with wrong samples, of {len(by)}", wrong, 0),
        Check(f"{name}: colours", _relative(actual.rgb, expected.rgb), 2e-4),
        Check(f"{name}: colours without gradients", _relative(shaded, expected.rgb), 2e-4),
        *(Check(f"{name}: gradient of {kind}", _relative(gradients[kind], slopes[kind]), 1e-3) for kind in slopes),
    ]


@torch.no_grad()
def marched(s: Scene, name: str, exact: Scene) -> list[Check]:
    """What the march itself says: optical depths, and which samples it keeps at a threshold."""
    threshold, expected = 0.02, exact.render()
    depths = (torch.stack([x.sum() for x in of_rays(r, r.samples.tau)]) for r in (s.render(), expected))
    actual, weights = s.render(threshold), of_rays(expected, expected.composite.weights)
    kept = actual.samples.starts.diff().cpu()
    least, most = (torch.stack([(w > threshold * (1 + sign * 1e-3)).sum() for w in weights]) for sign in (1, -1))
    lost = torch.stack([w[w <= threshold].sum() for w in weights])
    return [
        Check(f"{name}: optical depths by the march", _relative(*depths), 1e-4),
        Check(f"{name}: rays that keep other samples than they should", int(((kept < least) | (kept > most)).sum()), 0),
        Check(f"{name}: mass of what is dropped", _relative(actual.samples.dropped_mass[:, 0], lost), 1e-2),
    ]


def marches(device: str, rehearse: bool) -> list[Check]:
    """One, four, nine and 33 MPIs, with and without the cube, blended and not."""
    cases: list[tuple[int, bool, CubePlan | None]]
    cases = [(4, True, CUBE), (1, False, None), (4, False, None), (4, True, None), (9, False, CUBE), (33, True, None)]
    checks = []
    for count, blends, cube in cases[: 1 if rehearse else None]:
        name = f"{count} MPIs{' and the cube' if cube else ''}, {'' if blends else 'no '}blending"
        checks += whole_rays(random_scene(count, 4 if rehearse else 200, blends, count, cube), name, device)
    return checks


# Kernels by themselves -----------------------------------------------------------------------------------------------


def _twice(bounds: dict[str, float], work: Callable[[torch.dtype], tuple[Tensor, ...]]) -> list[Check]:
    """What ``work`` makes in float32 against the same in float64, for which there is plain torch alone."""
    pairs = zip(bounds.items(), work(torch.float32), work(torch.float64), strict=True)
    return [Check(name, _relative(a, b), bound) for (name, bound), a, b in pairs]


def interpolation(device: str, samples: int) -> list[Check]:
    """Values and row gradients of 9 channels; many samples share rows."""
    g = torch.Generator().manual_seed(1)
    texels = max(10, samples // 3)
    rows = torch.randint(1, texels, (samples, 4), generator=g).to(device)  # row 0 is where gradients are padded
    weights, upstream = torch.rand(samples, 4, generator=g).to(device), _draw(device, samples, 9, seed=2)

    def work(dtype: torch.dtype) -> tuple[Tensor, ...]:
        table = interpolate.Table(_draw(device, texels, 9).to(dtype))
        if dtype == torch.float32:
            read = interpolate.interpolate(table, rows, weights)
            (read * upstream).sum().backward()
            gradient = dense_grad(table)
        else:
            read = interpolate.interpolate_densely(values := table.data.requires_grad_(), rows, weights.to(dtype))
            (gradient,) = torch.autograd.grad((read * upstream).sum(), values)
        assert gradient is not None
        return read, gradient

    return _twice({"interpolation": 1e-6, "interpolation: row gradients": 5e-6}, work)


def distinct_rows(device: str, samples: int) -> list[Check]:
    """The rows of a batch, each once, and what is summed over them."""
    g = torch.Generator().manual_seed(2)
    texels = 40 * samples
    pool = torch.randint(0, texels, (max(1, samples // 3),), generator=g)
    rows = pool[torch.randint(0, len(pool), (samples, 4), generator=g)].to(device)
    index, expected = interpolate.index_rows(rows, texels), rows.unique()
    wrong = int(len(index.unique) != len(expected)) or int((index.unique != expected).sum())
    wrong += int((index.unique[index.positions.long()] != rows).sum())
    values, weights = _draw(device, samples, 9), torch.rand(samples, 4, generator=g).to(device)

    def work(dtype: torch.dtype) -> tuple[Tensor, ...]:
        return (interpolate.sum_rows(index.positions, values.to(dtype), weights.to(dtype), len(expected)),)

    return [Check("distinct rows: wrong", wrong, 0), *_twice({"distinct rows: sums": 5e-6}, work)]


def variations(device: str, texels: int) -> list[Check]:
    """Total variation of MPIs and a cube with its gradient."""
    field = random_scene(3, 1, False, cube=CUBE).field.to(device)
    table = _draw(device, len(field.density), 9) * 2
    rows = torch.cat([grid.rows for grid in field.grids])  # not those of bricks that stick out over a plane's border
    some = torch.randperm(len(rows), generator=torch.Generator().manual_seed(1))[:texels]
    rows = rows[some.to(rows.device)].sort().values.to(device)

    def work(dtype: torch.dtype) -> tuple[Tensor, ...]:
        values = table[rows].to(dtype).requires_grad_()
        scales = torch.tensor([(0.5, 2.0, 1.0)] * len(field.grids), device=device)
        value = variation.total_variation(values, table.to(dtype), rows, field.layout, scales)
        value.backward()
        assert values.grad is not None
        return value[None], values.grad

    return _twice({"total variation": 1e-5, "total variation: gradient": 1e-5}, work)


def adam(device: str, rows: int) -> list[Check]:
    """Four steps on touched rows, with moments in bfloat16 too, whose roundings these four steps keep small."""

    def work(dtype: torch.dtype) -> tuple[Tensor, ...]:
        table = interpolate.Table(_draw(device, rows, 9).to(dtype))
        optimizer = TouchedAdam([table], lr=0.1)
        for step in range(4):
            chosen = torch.randperm(rows, generator=torch.Generator().manual_seed(step))[: rows // 2].sort().values
            table.grad = None
            table.add_grad(chosen.to(device), _draw(device, rows // 2, 9, seed=step).to(dtype))
            optimizer.step()
        return (table.data,)

    return _twice({"Adam on rows": 1e-2}, work)


def run_checks(device: str, rehearse: bool) -> dict[str, Any]:
    """Every check; one that raises has failed.

    Raises:
        RuntimeError: the kernels are not there to be checked.
    """
    one = torch.zeros(1, device=device)
    missing = [n for n, of in dispatch.OPERATIONS.items() if "gpu" in of.compiled and dispatch.form_of(n, one) != "gpu"]
    if missing:
        raise RuntimeError(f"there are no kernels to be checked for {', '.join(missing)} (the log says why)")
    size, rows = 500 if rehearse else 200_000, list[dict[str, Any]]()
    groups: list[Callable[[], list[Check]]] = [  # at the sizes of a training step, or small
        lambda: interpolation(device, size),
        lambda: distinct_rows(device, size),
        lambda: variations(device, 200 if rehearse else 100_000),
        lambda: adam(device, size),
        lambda: marches(device, rehearse),
    ]
    for number, work in enumerate(groups):
        try:
            rows += [{**asdict(c), "ok": c.ok} for c in work()]
        except Exception as error:  # the others are still worth knowing
            failed: dict[str, Any] = {"name": f"group {number}", "error": None, "bound": 0.0, "ok": False}
            rows.append(failed | {"raised": repr(error)[:400]})
    return {"checks": rows, "failed": sum(not r["ok"] for r in rows)}
