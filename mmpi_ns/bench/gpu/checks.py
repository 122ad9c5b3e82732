"""Correctness on the device: every Triton kernel against float64, before anything is timed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mmpi_ns.bench.rendering import bundle_of, render
from mmpi_ns.bench.stability.exact_ray import ExactField, ExactRay, Gradients
from mmpi_ns.bench.stability.rays import CLEAR, CUBE, Scene, scene
from mmpi_ns.field.baking import baked_shares
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import metadata_of
from mmpi_ns.ops import dispatch, interpolate, variation
from mmpi_ns.ops.blending import BlendForm, blended_optical_depth, interpolate_shares
from mmpi_ns.ops.composite import composite_weights
from mmpi_ns.ops.composite import reference as plain_composite
from mmpi_ns.ops.interpolate import reference as plain_interpolate
from mmpi_ns.ops.march.reference import NEGLIGIBLE_DEPTH
from mmpi_ns.ops.variation import reference as plain_variation
from mmpi_ns.rendering.sampler import MMPISampler
from mmpi_ns.scene.plan import CubePlan
from mmpi_ns.training.touched_adam import TouchedAdam

FORMS: tuple[BlendForm, ...] = ("paper", "opacity")


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


def _relative(found: Tensor, wanted: Tensor) -> float:
    """Largest difference relative to the largest wanted number; infinite where something is not finite."""
    found, wanted = found.double().cpu(), wanted.double().cpu()
    if found.shape != wanted.shape or not bool(torch.isfinite(found).all()):
        return float("inf")
    return float((found - wanted).abs().max() / wanted.abs().max().clamp(min=1e-12)) if wanted.numel() else 0.0


def _draw(device: str, *shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).to(device)


# Whole rays ----------------------------------------------------------------------------------------------------------


def whole_rays(s: Scene, name: str, device: str) -> list[Check]:
    """March, interpolation and compositing together, values and gradients, against exact arithmetic."""
    known, field = ExactField.of(s.field), s.field.to(device)
    exact = [ExactRay(known, o, d) for o, d in zip(s.origins, s.directions, strict=True)]
    clear = [i for i, ray in enumerate(exact) if ray.margin > CLEAR]
    upstream = np.random.default_rng(0).normal(size=(len(exact), 3))
    wanted, slopes, sizes = [], known.zeros(), known.zeros()
    for i in clear:
        wanted.append(torch.tensor(exact[i].render(s.form)[0]))
        exact[i].add_gradient(upstream[i], s.form, slopes, sizes)
    rays = bundle_of(s.origins, s.directions).to(device)
    found = render(field, rays, form=s.form)
    rgb, kept = found.rgb, metadata_of(found.samples)["valid"].sum((1, 2))
    by = torch.tensor(upstream, dtype=torch.float32, device=device)
    (rgb[clear] * by[clear]).sum().backward()
    wrong = sum(int(kept[i]) != len(exact[i].samples) for i in clear)
    with torch.no_grad():
        shaded = render(field, rays, form=s.form, known_lookup=False).rgb
    checks = [
        *marched(s, name, field, device, exact, clear),
        Check(f"{name}: rays with a wrong number of samples, of {len(clear)}", wrong, 0),
        Check(f"{name}: colours", _relative(rgb[clear].detach(), torch.stack(wanted)), 2e-4),
        Check(f"{name}: colours without gradients", _relative(shaded[clear], torch.stack(wanted)), 2e-4),
    ]
    for kind in ("density", "features", *(["reliability"] if s.form else [])):
        checks.append(Check(f"{name}: gradient of {kind}", _slope_error(field, kind, slopes), 1e-3))
    return checks


@torch.no_grad()
def marched(s: Scene, name: str, field: MMPIField, device: str, exact: list[ExactRay], clear: list[int]) -> list[Check]:
    """What the march itself says: optical depths, and which samples it keeps at a threshold."""
    rays, threshold = bundle_of(s.origins, s.directions).to(device), 0.02
    samples, _ = MMPISampler()(rays, field=field, threshold=0.0, blend_form=s.form)
    depth = metadata_of(samples)["tau"][..., 0].sum(-1)[clear]
    wanted = torch.tensor([sum(b.depth for b in exact[i].blended(s.form)) for i in clear])
    samples, report = MMPISampler()(rays, field=field, threshold=threshold, blend_form=s.form)
    kept, wrong, lost = metadata_of(samples)["valid"][..., 0].sum(-1), 0, []
    for i in clear:
        weights = exact[i].render(s.form)[1].weights
        lost.append(float(weights[weights <= threshold].sum()))
        sure = [int((weights > threshold * (1 + sign * 1e-3)).sum()) for sign in (1, -1)]
        wrong += not sure[0] <= int(kept[i]) <= sure[1]
    return [
        Check(f"{name}: optical depths by the march", _relative(depth, wanted), 1e-4),
        Check(f"{name}: rays that keep other samples than they should", wrong, 0),
        Check(f"{name}: mass of what is dropped", _relative(report.dropped_mass[clear, 0], torch.tensor(lost)), 1e-2),
    ]


def _slope_error(field: MMPIField, kind: str, slopes: Gradients) -> float:
    found, texels = getattr(field, kind).grad, torch.cat([grid.rows for grid in field.grids])
    found = found.to_dense() if found.is_sparse else found
    return _relative(found[texels], torch.tensor(slopes.flat(kind)))


def marches(device: str, rehearse: bool) -> list[Check]:
    """One, four and nine heads, with and without the cube, in every form of blending."""
    cases: list[tuple[int, BlendForm | None, CubePlan | None]]
    cases = [(4, "paper", CUBE), (1, None, None), (4, None, None), (4, "opacity", None), (9, None, CUBE)]
    found = []
    for count, form, cube in cases[: 1 if rehearse else None]:
        name = f"{count} MPIs{' and the cube' if cube else ''}, {form or 'no'} blending"
        found += whole_rays(scene(count, 4 if rehearse else 24, form, seed=count, cube=cube), name, device)
    return found


@torch.no_grad()
def baked_march(device: str, rehearse: bool) -> list[Check]:
    """Optical depths blended by shares at texels, against the same blending of plain samples in float64."""
    s, found = scene(3, 4 if rehearse else 200, "paper", seed=5, cube=CUBE), []
    field, rays = s.field.to(device), bundle_of(s.origins, s.directions).to(device)
    shares = baked_shares(field)
    plain = metadata_of(MMPISampler()(rays, field=field, threshold=0.0)[0])
    valid = plain["valid"][..., 0]
    tau, ndc, heads = (plain[name][valid].double().cpu() for name in ("tau", "ndc", "heads"))
    share = interpolate_shares(field.cpu().layout, shares.double().cpu(), ndc, heads[:, 0].long())
    field.to(device)
    for form in FORMS[: 1 if rehearse else None]:
        made = metadata_of(MMPISampler()(rays, field=field, threshold=0.0, blend_form=form, shares=shares)[0])
        wanted = blended_optical_depth(tau[:, 0], share.log(), torch.log1p(-share), form)
        wanted = torch.where(tau[:, 0] > NEGLIGIBLE_DEPTH, wanted, tau[:, 0] / len(field.grids))
        found.append(Check(f"shares at texels, {form} blending", _relative(made["tau"][valid][:, 0], wanted), 1e-4))
    return found


# Kernels by themselves -----------------------------------------------------------------------------------------------


def interpolation(device: str, samples: int) -> list[Check]:
    """Values and row gradients of 9 channels; many samples share rows."""
    g = torch.Generator().manual_seed(1)
    texels = max(10, samples // 3)
    rows = torch.randint(1, texels, (samples, 4), generator=g).to(device)  # row 0 is where gradients are padded
    weights, upstream = torch.rand(samples, 4, generator=g).to(device), _draw(device, samples, 9, seed=2)
    table, exact = _draw(device, texels, 9).requires_grad_(), _draw(device, texels, 9).double().requires_grad_()
    read = interpolate.interpolate(table, rows, weights)
    wanted = plain_interpolate.interpolate(exact, rows, weights.double())
    (read * upstream).sum().backward()
    (wanted * upstream).sum().backward()
    assert table.grad is not None and exact.grad is not None
    return [
        Check("interpolation", _relative(read.detach(), wanted.detach()), 1e-6),
        Check("interpolation: row gradients", _relative(table.grad.to_dense(), exact.grad), 5e-6),
    ]


def distinct_rows(device: str, samples: int) -> list[Check]:
    """The rows of a batch, each once, and what is summed over them."""
    g = torch.Generator().manual_seed(2)
    texels = 40 * samples
    pool = torch.randint(0, texels, (max(1, samples // 3),), generator=g)
    rows = pool[torch.randint(0, len(pool), (samples, 4), generator=g)].to(device)
    index, wanted = interpolate.index_rows(rows, texels), rows.unique()
    wrong = int(len(index.unique) != len(wanted)) or int((index.unique != wanted).sum())
    wrong += int((index.unique[index.position.long()] != rows).sum())
    values, weights = _draw(device, samples, 9), torch.rand(samples, 4, generator=g).to(device)
    total = interpolate.sum_rows(index.position, values, weights, len(wanted))
    each = (values[:, None].double() * weights[..., None]).reshape(-1, 9)
    exact = torch.zeros(len(index.unique), 9, dtype=torch.float64, device=device)
    exact.index_add_(0, index.position.reshape(-1).long(), each)
    return [Check("distinct rows: wrong", wrong, 0), Check("distinct rows: sums", _relative(total, exact), 5e-6)]


def variations(device: str, texels: int) -> list[Check]:
    """Total variation of MPIs and a cube with its gradient."""
    field = scene(3, 1, None, cube=CUBE).field.to(device)
    table = _draw(device, len(field.density), 9) * 2
    rows = torch.randperm(len(table), generator=torch.Generator().manual_seed(1))[:texels].to(device)
    scales, found = [(0.5, 2.0, 1.0)] * len(field.grids), []
    for form, dtype in ((variation, torch.float32), (plain_variation, torch.float64)):
        values = table[rows].to(dtype).requires_grad_()
        value = form.total_variation(values, table.to(dtype), rows, field.layout, scales)
        value.backward()
        found.append((value.detach()[None], values.grad))
    (value, slope), (exact, exact_slope) = found
    return [
        Check("total variation", _relative(value, exact), 1e-5),
        Check("total variation: gradient", _relative(slope, exact_slope), 1e-5),
    ]


def compositing_kernels(device: str, rays: int, slots: int) -> list[Check]:
    """Thin, ordinary and opaque samples, and rays without any."""
    g = torch.Generator().manual_seed(3)
    tau = (10 ** (torch.rand(rays, slots, generator=g) * 6 - 5)).to(device)
    valid = (torch.arange(slots) < torch.randint(0, slots + 1, (rays, 1), generator=g)).to(device)
    before = (torch.rand(rays, slots, generator=g).cumsum(1) * 0.02).to(device)
    upstream, found = _draw(device, rays, slots), []
    for function, dtype in ((composite_weights, torch.float32), (plain_composite.composite_weights, torch.float64)):
        leaf = tau.to(dtype, copy=True).requires_grad_()
        made = function(leaf, valid, before.to(dtype), before[:, -1:].to(dtype))
        ((made.weights * upstream).sum() + made.accumulation.sum()).backward()
        found.append((made.weights.detach(), made.transmittance.detach(), leaf.grad))
    names = ("weights", "transmittance", "gradient")
    return [
        Check(f"compositing: {name}", _relative(a, b), 5e-6) for name, a, b in zip(names, *found, strict=True)
    ]  # fmt: skip


def adam(device: str, rows: int) -> list[Check]:
    """Four steps on touched rows."""
    found = []
    for dtype in (torch.float32, torch.float64):  # and moments in bfloat16, whose roundings these four steps keep small
        param = torch.nn.Parameter(_draw(device, rows, 9).to(dtype))
        optimizer = TouchedAdam([param], lr=0.1)
        for step in range(4):
            chosen = torch.randint(0, rows, (rows // 2,), generator=torch.Generator().manual_seed(step)).to(device)
            values = _draw(device, rows // 2, 9, seed=step).to(dtype)
            param.grad = torch.sparse_coo_tensor(chosen[None], values, param.shape)
            optimizer.step()
        found.append(param.data)
    return [Check("Adam on rows", _relative(*found), 1e-2)]


def everything(device: str, rehearse: bool) -> list[Callable[[], list[Check]]]:
    """All comparisons, at the sizes of a training step (or small)."""
    size = 500 if rehearse else 200_000
    return [
        lambda: interpolation(device, size),
        lambda: distinct_rows(device, size),
        lambda: compositing_kernels(device, 20 if rehearse else 4096, 37 if rehearse else 150),
        lambda: variations(device, 200 if rehearse else 100_000),
        lambda: adam(device, size),
        lambda: marches(device, rehearse),
        lambda: baked_march(device, rehearse),
    ]


def run_checks(device: str, rehearse: bool) -> dict[str, Any]:
    """Every check; one that raises has failed.

    Raises:
        RuntimeError: the kernels are not there to be checked.
    """
    one = torch.zeros(1, device=device)
    plain = [n for n, (_, forms) in dispatch.TABLE.items() if "gpu" in forms and dispatch.form_of(n, one) != "gpu"]
    if plain:
        raise RuntimeError(f"there are no kernels to be checked for {', '.join(plain)} (the log says why)")
    rows: list[dict[str, Any]] = []
    for number, work in enumerate(everything(device, rehearse)):
        try:
            rows += [{**asdict(c), "ok": c.ok} for c in work()]
        except Exception as error:  # the others are still worth knowing
            rows.append(
                {"name": f"group {number}", "error": None, "bound": 0.0, "ok": False, "raised": repr(error)[:400]}
            )
    return {"checks": rows, "failed": sum(not r["ok"] for r in rows)}
