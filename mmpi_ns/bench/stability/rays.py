"""Stability of whole rays: colour and the gradient of every table against the exact renderer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from mmpi_ns.bench.rendering import Rendered, bundle_of, render
from mmpi_ns.bench.stability.cases import (
    UNIT,
    Case,
    Error,
    Outcome,
    Precision,
    as_array,
    compare,
    count_wrong,
    plan_of,
    random_mpi,
    rays_at,
    rotation,
    single,
    snap,
)
from mmpi_ns.bench.stability.exact import Array, Jitter
from mmpi_ns.bench.stability.exact_ray import TABLES, ExactField, ExactRay, Gradients
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import metadata_of
from mmpi_ns.ops.blending import BlendForm
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan

GROUP = "whole rays"
DRAWS = 4
"""Times that the inputs of every step are moved to see how much the exact result depends on them."""
MOVE = 8 * UNIT
"""How far: a rotated offset has 4 roundings and a lookup as many again."""
CLEAR = 64 * UNIT
"""Rays on which a decision is closer than this (relative to the numbers compared) may differ and are left out."""
EXPECTATION = (
    "the exact samples in the exact order; colours and gradients within what moving every input by 8 roundings does"
)


@dataclass(frozen=True)
class Scene:
    """A field with known tables, and rays."""

    field: MMPIField
    origins: Array
    directions: Array
    form: BlendForm | None = None
    far: float = math.inf


WIDE = np.array([-1.0, 1.0, -1.0, 1.0])

# Scenes --------------------------------------------------------------------------------------------------------------


def _raw(wanted: Array, scale: float, biases: Array) -> Array:
    """Raw densities that give optical depths ``wanted`` [L, texels]."""
    x = wanted / scale
    return np.where(x > 30, x, np.log(np.expm1(np.minimum(x, 30)))) - biases[:, None]


def filled(plan: ScenePlan, seed: int, log_depths=(-2.5, 0.5), density: float = 0.0, votes: float = 3.0) -> MMPIField:
    """Random tables: optical depths of 10^log_depths, or raw densities +-density; all texels trained."""
    rng = np.random.default_rng(seed)
    field = MMPIField(plan, feature_channels=5, hidden_width=6, samples_per_voxel=1.5).eval()
    field.density.data.uniform_(-3, 1, generator=torch.Generator().manual_seed(seed))
    for k, grid in enumerate(field.grids[: len(plan.mpis)]):
        texels = grid.height * grid.width
        planes = torch.arange(grid.depth)
        # The biases as the field has them: what softplus gives for raw = 0.
        scale = 256 / grid.depth
        with torch.no_grad():
            start = field.layout.optical_depth(k, torch.zeros(grid.depth), planes).double().numpy() / scale
        biases = np.log(np.expm1(start))
        wanted = 10 ** rng.uniform(*log_depths, size=(grid.depth, texels))
        raw = _raw(wanted, scale, biases) if not density else rng.uniform(-density, density, (grid.depth, texels))
        field.density.data[grid.rows, 0] = torch.tensor(raw.reshape(-1), dtype=torch.float32)
    field.features.data = torch.tensor(rng.normal(size=field.features.shape), dtype=torch.float32)
    field.reliability.data = torch.tensor(rng.normal(size=field.reliability.shape) * votes, dtype=torch.float32)
    field.networks.weights.data = torch.tensor(rng.normal(size=field.networks.weights.shape) * 0.3, dtype=torch.float32)
    field.touched.fill_(1)
    return field


def _mpis(count: int, seed: int, scale: float = 1.0, shift: float = 0.0, planes: int = 12) -> list[MPIPlan]:
    """MPIs side by side that face about the same way, so that most points are covered by several."""
    rng = np.random.default_rng(seed)
    base, mpis = rotation(rng), []
    for _ in range(count):
        turn, _ = np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
        axes = (turn * np.sign(np.diag(turn))).T @ base
        mpi = random_mpi(
            rng, planes, axes, near=float(rng.uniform(0.8, 1.6)), extent=tuple(rng.uniform(0.7, 1.3, 4) * WIDE)
        )
        origin = tuple(shift + scale * x for x in rng.normal(size=3) * 0.4)
        mpis.append(snap(replace(mpi, origin=origin, near=scale * mpi.near)))
    return mpis


def scene(
    count: int,
    rays: int,
    form: BlendForm | None,
    seed: int = 0,
    *,
    scale: float = 1.0,
    shift: float = 0.0,
    cube: CubePlan | None = None,
    untrained: float = 0.0,
    **tables,
) -> Scene:
    """Random MPIs around a point, tables, and rays into them."""
    mpis = _mpis(count, seed, scale, shift)
    field = filled(plan_of(mpis, cube, 0.05 * scale), seed, **tables)
    if untrained:
        field.touched[torch.rand(len(field.touched), generator=torch.Generator().manual_seed(0)) < untrained] = 0
    return Scene(field, *rays_at(np.random.default_rng(seed + 100), mpis, rays), form)


CUBE = CubePlan((-1.5, -1.25, -1.0), (1.5, 1.5, 2.0), (6, 5, 4))


def _twins() -> Scene:
    """Two identical MPIs: every distance ties."""
    mpi = _mpis(1, 3)[0]
    field = filled(plan_of([mpi, mpi]), 3)
    return Scene(field, *rays_at(np.random.default_rng(4), [mpi], 8), "paper")


# Measures ------------------------------------------------------------------------------------------------------------


def _exact(known: ExactField, s: Scene, i: int, jitter: Jitter | None = None) -> ExactRay:
    near = float(single(known.plan.ray_near))
    return ExactRay(known, s.origins[i], s.directions[i], near, s.far, jitter or Jitter())


def _shared(ray: ExactRay) -> bool:
    """Whether several heads cover some sample."""
    return any(sample.cover.sum() > 1 for sample in ray.samples)


def _wrong_samples(found: Rendered, rays: list[ExactRay]) -> int:
    """Samples in a wrong place, too many or too few."""
    meta, wrong = metadata_of(found.samples), 0
    for i, ray in enumerate(rays):
        valid = meta["valid"][i, :, 0]
        pairs = zip(meta["heads"][i, :, 0][valid].tolist(), meta["planes"][i, :, 0][valid].tolist(), strict=True)
        wrong += list(pairs) != [(s.head, s.plane) for s in ray.samples]
    return wrong


def _gradients(known: ExactField, rays: list[ExactRay], by: Array, form: str | None) -> tuple[Gradients, Gradients]:
    total, size = known.zeros(), known.zeros()
    for ray, by_color in zip(rays, by, strict=True):
        ray.add_gradient(by_color, form, total, size)
    return total, size


def measure(s: Scene, precision: Precision) -> Outcome:
    """Colours of all clear rays, and the gradient of a random mixture of them by every table."""
    known = ExactField.of(s.field)
    exact = [_exact(known, s, i) for i in range(len(s.origins))]
    clear = [i for i, ray in enumerate(exact) if ray.margin > CLEAR and ray.samples]
    if len(clear) < len(exact) / 4:
        raise ValueError(f"Only {len(clear)} of {len(exact)} rays are clear: choose other rays for this case.")
    if s.form is not None and known.plan.num_heads > 1 and not any(_shared(exact[i]) for i in clear):
        raise ValueError("No sample of this case is covered twice: nothing is blended.")
    s = replace(s, origins=s.origins[clear], directions=s.directions[clear])
    exact = [exact[i] for i in clear]
    by = single(np.random.default_rng(9).normal(size=(len(clear), 3)))
    tables = (s.field.density, s.field.features, s.field.reliability, s.field.networks.weights)
    for table in tables:
        table.grad = None
        table.requires_grad_()
    near = float(single(known.plan.ray_near))
    with precision.context():
        found = render(s.field, bundle_of(s.origins, s.directions, near, s.far), form=s.form)
        (found.rgb * torch.tensor(by, dtype=torch.float32)).sum().backward()
    wrong = _wrong_samples(found, exact)
    if wrong:
        return Outcome(count_wrong(wrong))
    wanted = np.array([ray.render(s.form)[0] for ray in exact])
    slopes, sizes = _gradients(known, exact, by, s.form)
    moved_color, moved_slope = np.zeros(len(clear)), dict.fromkeys(TABLES, 0.0)
    for draw in range(DRAWS):
        rays = [_exact(known, s, i, Jitter(MOVE, 8 * precision.network_unit, 31 * draw + i)) for i in range(len(clear))]
        colors = np.array([ray.render(s.form)[0] for ray in rays])
        moved_color = np.maximum(moved_color, np.abs(colors - wanted).max(-1))
        moved, _ = _gradients(known, rays, by, s.form)
        for name in TABLES:
            moved_slope[name] = max(moved_slope[name], float(np.abs(moved.flat(name) - slopes.flat(name)).max()))
    errors = [
        Error(float(np.abs(as_array(found.rgb[i]) - wanted[i]).max()), 2 * float(moved_color[i]) + 16 * UNIT)
        for i in range(len(clear))
    ]
    texels = torch.cat([grid.rows for grid in s.field.grids])
    rows_of = {name: None if name == "networks" else texels for name in TABLES}
    gradients = [
        _gradient_error(table, rows_of[name], slopes.flat(name), sizes.flat(name), moved_slope[name], precision)
        for name, table in zip(TABLES, tables, strict=True)
        if table.grad is not None and np.abs(sizes.flat(name)).max() > 0
    ]
    return Outcome(Error.worst(errors), Error.worst(gradients))


def _gradient_error(
    table: torch.Tensor, rows: torch.Tensor | None, slope: Array, size: Array, moved: float, precision: Precision
) -> Error:
    """Error of a table's gradient (of some rows) relative to the largest sum of magnitudes that an entry is made of."""
    assert table.grad is not None
    gradient = table.grad.to_dense() if table.grad.is_sparse else table.grad
    found = as_array(gradient if rows is None else gradient[rows]).reshape(slope.shape)
    largest = float(size.max())
    if not np.isfinite(found).all():
        return Error(math.inf, 0.0)
    error = float(np.abs(found - slope).max()) / largest
    # Colours reach every table through a network, forwards in its arithmetic and, but for reliability, backwards.
    return Error(error, 2 * moved / largest + 16 * precision.network_unit)


def _chunks(s: Scene, precision: Precision, threshold: float) -> Outcome:
    """The same rays all at once and in pieces of 1, 7 and 19; and in another order."""
    count = len(s.origins)
    with torch.no_grad(), precision.context():

        def go(rows: Array) -> tuple[Array, Array]:
            made = render(s.field, bundle_of(s.origins[rows], s.directions[rows]), threshold, s.form)
            return as_array(made.rgb), as_array(made.composite.transmittance)

        whole = go(np.arange(count))
        errors = []
        order = np.random.default_rng(0).permutation(count)
        shuffled = go(order)
        errors += [compare(b, a[order], 1.0, 8) for a, b in zip(whole, shuffled, strict=True)]
        for size in (1, 7, 19):
            parts = [go(np.arange(i, min(i + size, count))) for i in range(0, count, size)]
            for a, b in zip(whole, zip(*parts, strict=True), strict=True):
                errors.append(compare(np.concatenate(b), a, 1.0, 8))
    # A network's matrix products may be cut differently in another batch: its arithmetic rounds the colours.
    return Outcome(Error.worst([Error(e.error, 8 * precision.network_unit) for e in errors]))


def _threshold(s: Scene, precision: Precision, threshold: float) -> Outcome:
    """Dropping samples changes a colour by no more than the mass that was dropped."""
    with torch.no_grad(), precision.context():
        rays = bundle_of(s.origins, s.directions)
        whole, part = (render(s.field, rays, t, s.form) for t in (0.0, threshold))
    dropped = as_array(part.report.dropped_mass)
    excess = np.maximum(np.abs(as_array(part.rgb - whole.rgb)) - dropped, 0)
    # Optical depth that both gather differs by what lies behind 1e-4 of the light or is thinner than 1e-4.
    lost = Error(float(excess.max()), 64 * precision.network_unit + 2e-4)
    return Outcome(lost if float(dropped.max()) > 0 else count_wrong(1))


def _nothing(precision: Precision) -> Outcome:
    """Rays that meet nothing, alone and beside one that meets planes, and no rays at all."""
    s = scene(2, 2, "paper", 5)
    away = np.array([-np.sum([np.array(m.axes[2]) for m in s.field.plan.mpis], 0)])
    away = away / np.linalg.norm(away)
    far_off = np.array(s.field.plan.mpis[0].origin)[None] + 1e4 * away
    errors = []
    for origins, directions in (
        (far_off, away),
        (np.concatenate([far_off, s.origins[:1]]), np.concatenate([away, s.directions[:1]])),
        (np.zeros((0, 3)), np.zeros((0, 3))),
    ):
        rays = bundle_of(origins.reshape(-1, 3), directions.reshape(-1, 3))
        rays = rays[: len(origins)]
        with precision.context():
            found = render(s.field, rays, 0.0, "paper")
        count = min(1, len(origins))
        errors.append(compare(found.rgb[:count], np.zeros((count, 3)), 1.0, 0))
        errors.append(compare(found.composite.transmittance[:count], np.ones((count, 1)), 1.0, 0))
        errors.append(count_wrong(int((~torch.isfinite(found.rgb)).sum())))
    return Outcome(Error.worst(errors))


def cases() -> list[Case]:
    """All cases of whole rays."""
    rows: list[tuple[str, Callable[[], Scene]]] = [
        ("1 MPI (K = 1)", lambda: scene(1, 16, None, 1)),
        ("4 MPIs, no reliability (joint)", lambda: scene(4, 10, None, 2)),
        ("4 MPIs, paper form", lambda: scene(4, 10, "paper", 2)),
        ("4 MPIs, opacity form", lambda: scene(4, 10, "opacity", 2)),
        ("4 MPIs and a cube, paper form", lambda: scene(4, 8, "paper", 6, cube=CUBE)),
        ("12 MPIs (K = 12), paper form", lambda: scene(12, 4, "paper", 7)),
        ("4 MPIs, 60 % of the texels untrained", lambda: scene(4, 10, "paper", 8, untrained=0.6)),
        ("two identical MPIs: all distances tie", _twins),
        ("raw densities +-1e4", lambda: scene(3, 10, "paper", 9, density=1e4)),
        ("reliabilities +-1e3", lambda: scene(3, 10, "paper", 10, votes=1e3)),
        ("optical depths 1e-12 to 1e-4", lambda: scene(3, 10, "paper", 11, log_depths=(-12, -4))),
        ("scene scale 1e-4", lambda: scene(3, 10, "paper", 12, scale=2.0**-13)),
        ("scene scale 1e5", lambda: scene(3, 10, "paper", 13, scale=2.0**17)),
        ("everything 1e6 units from the world's origin", lambda: scene(3, 12, "paper", 14, scale=8.0, shift=1e6)),
        ("finite far (8 units)", lambda: replace(scene(3, 12, "paper", 15), far=8.0)),
    ]
    result = [Case(GROUP, name, EXPECTATION, lambda p, make=make: measure(make(), p)) for name, make in rows]
    result += [
        Case(GROUP, f"32 rays in chunks of 1, 7, 19, all, and shuffled (threshold {t:g})", "the same colours",
             lambda p, t=t: _chunks(scene(4, 32, "paper", 16, cube=CUBE), p, t))
        for t in (0.0, 3e-3)
    ]  # fmt: skip
    result += [
        Case(GROUP, f"samples of less than {t:g} dropped", "colours within the dropped mass",
             lambda p, t=t: _threshold(scene(4, 100, "paper", 17, log_depths=(-3, 1.0)), p, t))
        for t in (1e-3, 3e-2)
    ]  # fmt: skip
    return [*result, Case(GROUP, "rays that meet nothing; no rays at all", "black and transparent, no NaN", _nothing)]
