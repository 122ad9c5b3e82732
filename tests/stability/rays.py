"""Stability of whole rays: colour and the gradient of every table against the exact renderer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from random_scenes import bundle_of, dense_grad, of_slots, render
from stability.cases import (
    UNIT,
    Case,
    Error,
    Outcome,
    Precision,
    as_array,
    compare,
    float32,
    plan_of,
    random_mpi,
    rays_at,
    rotation,
    single,
    snap,
)
from stability.exact import Array, Jitter
from stability.exact_ray import TABLES, ExactField, ExactRay, Gradients

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.interpolate import Table
from mmpi_ns.rendering.rendered import RenderedRays
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan

DRAWS = 4
"""Times that the inputs of every step are moved to see how much the exact result depends on them."""
MOVE = 8 * UNIT
"""How far: a rotated offset has 4 roundings and a lookup as many again."""
CLEAR = 64 * UNIT
"""Rays on which a decision is closer than this (relative to the numbers compared) may differ and are left out."""
CUBE = CubePlan((-1.5, -1.25, -1.0), (1.5, 1.5, 2.0), (6, 5, 4))

# Scenes --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """A field with known tables, and rays."""

    field: MMPIField
    origins: Array
    directions: Array
    blends: bool = False
    far: float = math.inf

    @property
    def near(self) -> float:
        return float(single(self.field.plan.ray_near))

    def bundle(self, rows: Any = slice(None)) -> RayBundle:
        """Some of the rays, on the field's device."""
        rays = bundle_of(self.origins[rows], self.directions[rows], self.near, self.far)
        return rays.to(self.field.density.device)

    def render(self, threshold: float = 0.0, rows: Any = slice(None)) -> RenderedRays:
        return render(self.field, self.bundle(rows), threshold, self.blends)

    def clear(self) -> tuple[Scene, list[ExactRay]]:
        """Those of its rays whose every decision is clear, and the same rays exactly."""
        known = ExactField.of(self.field)
        every = [ExactRay(known, o, d, self.near, self.far) for o, d in zip(self.origins, self.directions, strict=True)]
        kept = [i for i, ray in enumerate(every) if ray.margin > CLEAR and ray.samples]
        if len(kept) < len(every) / 4:
            raise ValueError(f"Only {len(kept)} of {len(every)} rays are clear: choose other rays for this case.")
        exact = [every[i] for i in kept]
        covered = [sample.cover.sum() for ray in exact for sample in ray.samples]
        if self.blends and known.plan.num_heads > 1 and max(covered) < 2:
            raise ValueError("No sample of this case is covered twice: nothing is blended.")
        return replace(self, origins=self.origins[kept], directions=self.directions[kept]), exact


def filled(plan: ScenePlan, seed: int, log_depths=(-2.5, 0.5), density: float = 0.0, votes: float = 3.0) -> MMPIField:
    """Random tables: optical depths of 10^log_depths, or raw densities +-density; all texels trained."""
    rng, g = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    field = MMPIField(plan, feature_channels=5, hidden_width=6, samples_per_voxel=1.5).eval().requires_grad_()
    field.density.data.uniform_(-3, 1, generator=g)
    for k, grid in enumerate(field.grids[: len(plan.mpis)]):
        # The biases as the field has them: what softplus gives for raw = 0.
        scale, shape = 256 / grid.depth, (grid.depth, grid.height * grid.width)
        with torch.no_grad():
            start = as_array(field.layout.optical_depth(k, torch.zeros(grid.depth), torch.arange(grid.depth))) / scale
        x = 10 ** rng.uniform(*log_depths, size=shape) / scale
        raw = np.where(x > 30, x, np.log(np.expm1(np.minimum(x, 30)))) - np.log(np.expm1(start))[:, None]
        raw = rng.uniform(-density, density, shape) if density else raw
        field.density.data[grid.rows, 0] = float32(raw.reshape(-1))
    tables = ((field.features, 1.0), (field.reliability, votes), (field.networks.weights, 0.3))
    for table, size in tables:
        table.data = float32(rng.normal(size=table.shape) * size)
    field.touched.fill_(1)
    return field


def _mpis(count: int, seed: int, scale: float = 1.0, shift: float = 0.0) -> list[MPIPlan]:
    """MPIs side by side that face about the same way, so that most points are covered by several."""
    rng = np.random.default_rng(seed)
    base, mpis = rotation(rng), []
    for _ in range(count):
        turn, _ = np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
        near, extent = float(rng.uniform(0.8, 1.6)), tuple(rng.uniform(0.7, 1.3, 4) * [-1, 1, -1, 1])
        axes = (turn * np.sign(np.diag(turn))).T @ base
        mpi = random_mpi(rng, 12, axes, near=near, extent=extent)
        origin = tuple(shift + scale * x for x in rng.normal(size=3) * 0.4)
        mpis.append(snap(replace(mpi, origin=origin, near=scale * mpi.near)))
    return mpis


def scene(
    count: int,
    rays: int,
    blends: bool,
    seed: int = 0,
    *,
    scale: float = 1.0,
    shift: float = 0.0,
    cube: CubePlan | None = None,
    untrained: float = 0.0,
    far: float = math.inf,
    **tables: Any,
) -> Scene:
    """Random MPIs around a point, tables, and rays into them."""
    mpis = _mpis(count, seed, scale, shift)
    field = filled(plan_of(mpis, cube, 0.05 * scale), seed, **tables)
    field.touched[torch.rand(len(field.touched), generator=torch.Generator().manual_seed(0)) < untrained] = 0
    return Scene(field, *rays_at(np.random.default_rng(seed + 100), mpis, rays), blends, far)


def _twins() -> Scene:
    """Two identical MPIs: every distance ties."""
    mpi = _mpis(1, 3)[0]
    field = filled(plan_of([mpi, mpi]), 3)
    return Scene(field, *rays_at(np.random.default_rng(4), [mpi], 8), True)


# Measures ------------------------------------------------------------------------------------------------------------


def wrong_samples(found: RenderedRays, rays: list[ExactRay]) -> int:
    """Samples in a wrong place, too many or too few."""
    valid, heads, planes = (of_slots(found, name).cpu() for name in ("valid", "heads", "planes"))
    wrong = 0
    for i, ray in enumerate(rays):
        pairs = zip(heads[i][valid[i]].tolist(), planes[i][valid[i]].tolist(), strict=True)
        wrong += list(pairs) != [(s.head, s.plane) for s in ray.samples]
    return wrong


def slopes_of(rays: list[ExactRay], by: Array, blends: bool) -> tuple[dict[str, Array], dict[str, float]]:
    """Derivatives of the sum of ``by`` times the rays' colours by every table, and the largest sum of magnitudes."""
    total = Gradients(rays[0].field)
    for ray, by_color in zip(rays, by, strict=True):
        ray.add_gradient(by_color, blends, total)
    slopes, sizes = ({n: total.flat(tables, n) for n in TABLES} for tables in (total.sums, total.sizes))
    return slopes, {name: float(size.max()) for name, size in sizes.items()}


def gradients_of(field: MMPIField, found: RenderedRays, by: Array) -> dict[str, Array]:
    """The same by the field's own tables, of those that have any."""
    texels = torch.cat([grid.rows for grid in field.grids])
    tables = {name: field.networks.weights if name == "networks" else getattr(field, name) for name in TABLES}
    field.zero_grad()
    found.rgb.backward(float32(by).to(field.density.device))
    read = {name: table for name, table in tables.items() if table.grad is not None}
    return {n: as_array(dense_grad(t)[texels] if isinstance(t, Table) else t.grad) for n, t in read.items()}


def measure(make: Callable[[], Scene], precision: Precision) -> Outcome:
    """Colours of all clear rays, and the gradient of a random mixture of them by every table."""
    s, exact = make().clear()
    by = single(np.random.default_rng(9).normal(size=(len(exact), 3)))
    with precision.context():
        found = s.render()
        gradients = gradients_of(s.field, found, by)
    if wrong := wrong_samples(found, exact):
        return Outcome.of([], wrong=wrong)
    wanted = np.array([ray.render(s.blends)[0] for ray in exact])
    slopes, sizes = slopes_of(exact, by, s.blends)
    moved_color, moved_slope = np.zeros(len(exact)), {name: 0.0 for name in gradients}
    for draw in range(DRAWS):
        jitters = [Jitter(MOVE, 8 * precision.network_unit, 31 * draw + i) for i in range(len(exact))]
        rays = [replace(ray, jitter=j, samples=[]) for ray, j in zip(exact, jitters, strict=True)]
        colors = np.array([ray.render(s.blends)[0] for ray in rays])
        moved_color = np.maximum(moved_color, np.abs(colors - wanted).max(-1))
        moved, _ = slopes_of(rays, by, s.blends)
        for name in gradients:
            moved_slope[name] = max(moved_slope[name], float(np.abs(moved[name] - slopes[name]).max()))
    off = np.abs(as_array(found.rgb) - wanted).max(-1)
    errors = [Error(float(a), 2 * float(b) + 16 * UNIT) for a, b in zip(off, moved_color, strict=True)]
    by_table = []
    for name, gradient in gradients.items():
        # An error counts against the largest sum of magnitudes that an entry is made of. Colours reach every table
        # through a network, forwards in its arithmetic and, but for reliability, backwards.
        if largest := sizes[name]:
            error = float(np.abs(gradient.reshape(slopes[name].shape) - slopes[name]).max()) / largest
            by_table.append(Error(error, 2 * moved_slope[name] / largest + 16 * precision.network_unit))
    return Outcome.of(errors, by_table)


def _chunks(threshold: float, precision: Precision) -> Outcome:
    """The same rays all at once and in pieces of 1, 7 and 19; and in another order."""
    s = scene(4, 32, True, 16, cube=CUBE)
    count, errors = len(s.origins), []
    order = np.random.default_rng(0).permutation(count)
    with torch.no_grad(), precision.context():

        def go(rows: Array) -> list[Array]:
            made = s.render(threshold, rows)
            return [as_array(made.rgb), as_array(made.composite.transmittance)]

        whole = go(np.arange(count))
        ways = [(order, [order])]
        ways += [(np.arange(count), np.split(np.arange(count), range(n, count, n))) for n in (1, 7, 19)]
        for rows, pieces in ways:
            for a, parts in zip(whole, zip(*map(go, pieces), strict=True), strict=True):
                # A network's matrix products may be cut differently in another batch: its rounding is that of colours.
                error = compare(np.concatenate(parts), a[rows], 1.0, 8).error
                errors.append(Error(error, 8 * precision.network_unit))
    return Outcome.of(errors)


def _threshold(threshold: float, precision: Precision) -> Outcome:
    """Dropping samples changes a colour by no more than the mass that was dropped."""
    s = scene(4, 100, True, 17, log_depths=(-3, 1.0))
    with torch.no_grad(), precision.context():
        whole, part = (s.render(t) for t in (0.0, threshold))
    dropped = as_array(part.samples.dropped_mass)
    excess = np.maximum(np.abs(as_array(part.rgb - whole.rgb)) - dropped, 0)
    # Optical depth that both gather differs by what lies behind 1e-4 of the light or is thinner than 1e-4.
    error = Error(float(excess.max()), 64 * precision.network_unit + 2e-4)
    return Outcome.of([error], wrong=int(dropped.max() <= 0))


def _nothing(precision: Precision) -> Outcome:
    """Rays that meet nothing, alone and beside one that meets planes, and no rays at all."""
    s = scene(2, 2, True, 5)
    away = -np.sum([m.axes[2] for m in s.field.plan.mpis], 0, keepdims=True)
    away = away / np.linalg.norm(away)
    origins = np.concatenate([np.array(s.field.plan.mpis[0].origin)[None] + 1e4 * away, s.origins[:1]])
    s, errors = replace(s, origins=origins, directions=np.concatenate([away, s.directions[:1]])), []
    for count in (1, 2, 0):
        with precision.context():
            found = s.render(rows=slice(count))
        first, rgb = min(1, count), found.rgb
        errors.append(compare(rgb[:first], np.zeros((first, 3)), 1.0, 0))
        errors.append(compare(found.composite.transmittance[:first], np.ones((first, 1)), 1.0, 0))
        errors.append(Error(float((~torch.isfinite(rgb)).sum()), 0.0))
    return Outcome.of(errors)


def cases() -> list[Case]:
    """All cases of whole rays."""
    rays: list[tuple[str, Callable[[], Scene]]] = [
        ("1 MPI (K = 1)", partial(scene, 1, 16, False, 1)),
        ("4 MPIs, no reliability (joint)", partial(scene, 4, 10, False, 2)),
        ("4 MPIs, blended", partial(scene, 4, 10, True, 2)),
        ("4 MPIs and a cube, blended", partial(scene, 4, 8, True, 6, cube=CUBE)),
        ("12 MPIs (K = 12), blended", partial(scene, 12, 4, True, 7)),
        ("4 MPIs, 60 % of the texels untrained", partial(scene, 4, 10, True, 8, untrained=0.6)),
        ("two identical MPIs: all distances tie", _twins),
        ("raw densities +-1e4", partial(scene, 3, 10, True, 9, density=1e4)),
        ("reliabilities +-1e3", partial(scene, 3, 10, True, 10, votes=1e3)),
        ("optical depths 1e-12 to 1e-4", partial(scene, 3, 10, True, 11, log_depths=(-12, -4))),
        ("scene scale 1e-4", partial(scene, 3, 10, True, 12, scale=2.0**-13)),
        ("scene scale 1e5", partial(scene, 3, 10, True, 13, scale=2.0**17)),
        ("everything 1e6 units from the world's origin", partial(scene, 3, 12, True, 14, scale=8.0, shift=1e6)),
        ("finite far (8 units)", partial(scene, 3, 12, True, 15, far=8.0)),
    ]
    exactly = (
        "the exact samples in the exact order; colours and gradients within what moving every input by 8 roundings "
    )
    exactly += "does"
    rows: list[tuple[str, str, Callable[[Precision], Outcome]]]
    rows = [(name, exactly, partial(measure, make)) for name, make in rays]
    for t in (0.0, 3e-3):
        name = f"32 rays in chunks of 1, 7, 19, all, and shuffled (threshold {t:g})"
        rows.append((name, "the same colours", partial(_chunks, t)))
    for t in (1e-3, 3e-2):
        rows.append((f"samples of less than {t:g} dropped", "colours within the dropped mass", partial(_threshold, t)))
    rows.append(("rays that meet nothing; no rays at all", "black and transparent, no NaN", _nothing))
    return [Case("whole rays", *row) for row in rows]
