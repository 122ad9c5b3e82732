"""Stability of the geometry: intersected planes, their (u, v) and 1/t, positions in other frames, the cube."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import oracle
from hand_made import samples_to_ndc
from plane_crossings import AHEAD, crossings
from random_scenes import Array, bundle_of
from stability.cases import (
    UNIT,
    Case,
    Error,
    Outcome,
    Precision,
    as_array,
    compare,
    float32,
    random_mpi,
    rays_at,
    single,
    snap,
)

from mmpi_ns.scene.geometry import Cube, Frames, cube_hits, plane_hits
from mmpi_ns.scene.plan import CubePlan, MPIPlan

ROUNDINGS = 16
"""Of (u, v), 1/t and what decides about a plane: 4 of a rotated offset, 3 of a rotated direction, a quotient of those,
a product and a sum, 4 of a disparity; docs/stability.md."""
RANGE = "exactly the intersected planes but where a border is within 16 roundings; (u, v) and 1/t to 16 roundings"
Rays = tuple[list[MPIPlan], Array, Array, float, float]
"""MPIs, origins and directions [R, 3], near, far."""


def measure_hits(rays: Callable[[], Rays], precision: Precision) -> Outcome:
    """Live planes, tangents and inverse distances of every ray in every MPI."""
    mpis, origins, directions, near, far = rays()
    frames, bundle = Frames.pack(mpis), bundle_of(origins, directions, near, far)
    with precision.context():
        hits = plane_hits(bundle.origins, bundle.directions, bundle.nears, bundle.fars, frames)  # type: ignore[arg-type]
    errors, wrong = [Error(0.0, ROUNDINGS * UNIT)], 0
    for k, mpi in enumerate(mpis):
        intersected, u, v, inverse_t = (as_array(x) for x in crossings(hits, frames, k, mpi.planes))
        for i in range(len(origins)):
            wanted = oracle.crossings(mpi, origins[i], directions[i], near, far)
            wrong += int((wanted.intersected != intersected[i])[wanted.margin > ROUNDINGS * UNIT].sum())
            both = wanted.intersected & (intersected[i] > 0)
            for actual, expected, size in (
                (u, wanted.u, wanted.size_uv),
                (v, wanted.v, wanted.size_uv),
                (inverse_t, wanted.inverse_t, wanted.size_q),
            ):
                errors.append(compare(actual[i, both], expected[both], size[both], ROUNDINGS))
    return Outcome.of(errors, wrong=wrong)


def measure_places(rays: Callable[[], Rays], precision: Precision) -> Outcome:
    """Where points along rays lie in every MPI, and whether inside; points at infinity among them."""
    mpis, origins, directions, _, _ = rays()
    rng, far_off = np.random.default_rng(1), np.arange(len(origins)) % 4 == 0
    reach = np.linalg.norm(origins - np.array(mpis[0].origin), axis=-1) + mpis[0].near
    inverse_t = single(np.where(far_off, 0, 1 / (reach * 10 ** rng.uniform(-1, 2, len(reach)))))
    with precision.context():
        ndc, inside = samples_to_ndc(float32(origins), float32(directions), float32(inverse_t), Frames.pack(mpis))
    errors, wrong = [Error(0.0, ROUNDINGS * UNIT)], 0
    for i, k in np.ndindex(len(origins), len(mpis)):
        wanted = oracle.place_in(mpis[k], origins[i], directions[i], float(inverse_t[i]))
        if wanted is None:
            wrong += bool(inside[i, k])
            continue
        place, size = wanted
        gap = float(np.abs(np.abs(place) - 1)[: 2 if inverse_t[i] == 0 else 3].min())
        if gap > 2 * ROUNDINGS * UNIT * size:
            wrong += bool(inside[i, k]) != bool((np.abs(place) <= 1).all())
        errors.append(compare(ndc[i, k], place, size, ROUNDINGS))
    return Outcome.of(errors, wrong=wrong)


def measure_cube(scale: float, parallel: bool, precision: Precision) -> Outcome:
    """Samples inside the cube, for rays from inside, from outside, past it and along its faces."""
    rng, count = np.random.default_rng(2), 300
    lower, upper = (tuple(single(scale * np.array(x)).tolist()) for x in ([-1.5, -1.2, -1.0], [1.4, 1.6, 2.0]))
    plan = CubePlan(lower, upper, (6, 5, 4))  # type: ignore[arg-type]
    cube = Cube.pack(plan, 1.5)
    origins, directions = single(rng.normal(size=(count, 3)) * 2 * scale), rng.normal(size=(count, 3))
    if parallel:
        directions[np.arange(count), np.arange(count) % 3] = 0
        directions[::5, 1:] = 0
        directions[::5, 0] = 1
    directions = single(directions / np.linalg.norm(directions, axis=-1, keepdims=True))
    near = float(single(0.05 * scale))
    rays = bundle_of(origins, directions, near)
    with precision.context():
        first, number = cube_hits(rays.origins, rays.directions, rays.nears, rays.fars, cube)  # type: ignore[arg-type]
    wrong = 0
    for i in range(count):
        wanted, margin = oracle.cube_samples(plan, cube.step, origins[i], directions[i], near, math.inf)
        wrong += margin > 64 * UNIT and wanted != list(range(int(first[i]), int(first[i] + number[i])))
    return Outcome.of([], wrong=wrong)


# The rays of each case -----------------------------------------------------------------------------------------------


def _anywhere(count: int, per_plan: int, scale: float = 1.0, shift: float = 0.0, seed: int = 0) -> Rays:
    """Random MPIs, moved by ``shift`` and scaled about it, and rays into them; some of the rays miss."""
    rng = np.random.default_rng(seed)
    mpis = [random_mpi(rng, planes=int(rng.integers(2, 40))) for _ in range(per_plan)]
    mpis = [snap(replace(m, origin=tuple(shift + scale * x for x in m.origin), near=scale * m.near)) for m in mpis]
    origins, directions = rays_at(rng, mpis, count)
    lost = rng.random(count) < 0.1
    directions[lost] *= -1
    return mpis, origins, directions, 0.05 * scale, math.inf


def _thousands(precision: Precision) -> Outcome:
    """2,400 poses: one random MPI and one ray for each dozen, so that frames vary as much as rays."""
    return Outcome.of([measure_hits(partial(_anywhere, 12, 1, seed=s), precision).value for s in range(200)])


def _alike(
    seed: int, count: int, rays: int, ends: float = math.inf, near: float = 0.05, spread: float = 0.6, **kind: Any
) -> Rays:
    """Random MPIs of one kind, which end at ``ends`` times their near plane, and rays into them."""
    rng = np.random.default_rng(seed)
    mpis = [random_mpi(rng, **kind) for _ in range(count)]
    mpis = [snap(replace(m, far=ends * m.near)) for m in mpis]
    return (mpis, *rays_at(rng, mpis, rays, spread), near, math.inf)


def front(extent=(-1.0, 1.0, -0.5, 0.5), origin=(0.0, 0.0, 0.0), planes: int = 9) -> MPIPlan:
    """An MPI that faces +z."""
    return snap(MPIPlan("front", origin, AHEAD, 1.0, extent, planes, 5, 7))


def _from(origins: Any, directions: Any, mpi: MPIPlan | None = None) -> Rays:
    """Rays from points, or all from one, about an MPI that faces +z."""
    o, d = np.broadcast_arrays(np.asarray(origins, np.float64), np.asarray(directions, np.float64))
    return [mpi or front()], single(o), single(d / np.linalg.norm(d, axis=-1, keepdims=True)), 0.0, math.inf


def _nearly_parallel() -> Rays:
    slopes = 10.0 ** np.linspace(-6.5, -1, 56)
    directions = np.stack([np.cos(np.arange(56.0)), np.sin(np.arange(56.0)), slopes], -1)
    return _from([0.3, -0.2, 0.5], directions, front((-1e7, 1e7) * 2))


def _behind(distance: float) -> Rays:
    rng = np.random.default_rng(3)
    targets = rng.uniform([-0.8, -0.4, 1], [0.8, 0.4, 1.0001], (64, 3)) * rng.uniform(1, 8, (64, 1))
    return _from([0.0, 0.0, -distance], targets + np.array([0.0, 0.0, distance]))


def _on_planes() -> Rays:
    origins = [[0.0, 0.0, z + step] for z in 8 / np.arange(8, 0, -1) for step in (-1e-3, 0.0, 1e-3)]
    return _from(origins, np.array([0, 0, 1]) + np.random.default_rng(4).normal(size=(24, 3)) * 0.05)


def _grazing() -> Rays:
    """Rays from the MPI's own origin along the borders of its frustum and an ulp beside them."""
    edge = np.float32(1.0)
    tangents = [edge, np.nextafter(edge, np.float32(2)), np.nextafter(edge, np.float32(0)), -edge, 0.999, 1.001]
    return _from([0.0, 0.0, 0.0], [[float(t), 0.3, 1.0] for t in tangents])


def _nearly_parallel_mpis() -> Rays:
    turned = ((1.0, 0.0, -1e-6), (0.0, 1.0, 0.0), (1e-6, 0.0, 1.0))
    mpis = [front(planes=33), snap(replace(front(planes=33, origin=(1e-6, 0.0, 1e-6)), axes=turned))]
    return (mpis, *rays_at(np.random.default_rng(5), mpis, 128), 0.05, math.inf)


def cases() -> list[Case]:
    """All cases of the geometry."""
    flat = [[1, 0, 0], [0, -1, 0], [0.6, 0.8, 0], [1, 0, 1e-7], [1, 0, -1e-9]]
    cone = np.array([0, 0, 1]) + np.random.default_rng(6).normal(size=(64, 3)) * 0.2
    past = cone + np.linspace(0, 2, 64)[:, None] * [1, 0, 0]
    last = "the plane at infinity alone, 1/t = 0"
    hits: list[tuple[str, str, Callable[[], Rays]]] = [
        ("12 random MPIs, 200 rays", RANGE, partial(_anywhere, 200, 12)),
        ("rays parallel to the planes (facing component 0, 1e-7, -1e-9)", "no intersected plane",
         partial(_from, [0, 0, 0.5], flat, front((-1e9, 1e9) * 2))),
        ("rays nearly parallel to the planes (facing component 3e-7 to 0.1)", RANGE, _nearly_parallel),
        ("rays that point away", "no intersected plane", partial(_from, [[0, 0, 50], [0, 0, -5]] * 32, -cone)),
        ("camera on a plane, and 1e-3 before and past it", RANGE, _on_planes),
        ("camera past all finite planes (500 units)", last, partial(_from, [0.2, 0.1, 500.0], cone)),
        ("camera 1e6 units ahead of the MPI", last, partial(_from, [3.0, -2.0, 1e6], cone)),
        ("camera 1e3 units behind the MPI", RANGE, partial(_behind, 1e3)),
        ("camera 1e6 units behind the MPI", RANGE, partial(_behind, 1e6)),
        ("camera beside every frustum, looking in and looking past", RANGE, partial(_from, [-10, 0, 0], past)),
        ("rays along the frustum's border, and one rounding beside it", RANGE, _grazing),
        ("finite far (9 units)", "no plane behind it, none at infinity",
         lambda: (*_anywhere(200, 4, seed=7)[:3], 2.0, 9.0)),
        ("cameras and MPIs 1e6 units from the world's origin", RANGE, partial(_anywhere, 200, 4, 8.0, 1e6, 8)),
        ("scene scale 1e-4", RANGE, partial(_anywhere, 300, 4, 1e-4, seed=9)),
        ("scene scale 1e5", RANGE, partial(_anywhere, 300, 4, 1e5, seed=10)),
        ("two MPIs turned by 1e-6 and moved by 1e-6 (nearly parallel planes)", RANGE, _nearly_parallel_mpis),
        ("MPIs that end at 1.5 times their near plane (bricks)", RANGE, partial(_alike, 17, 3, 120, 1.5, planes=24)),
        ("MPIs that end at 100 times their near plane", RANGE, partial(_alike, 17, 3, 120, 100.0, planes=24)),
        ("2 planes", RANGE, partial(_alike, 12, 2, 60, planes=2)),
        ("4,096 planes", RANGE, partial(_alike, 12, 2, 60, planes=4096)),
        ("a telephoto frustum (tangents +-1e-3)", RANGE,
         partial(_alike, 13, 2, 100, near=0.01, spread=2.5e-4, planes=24, extent=(-1e-3, 1e-3) * 2)),
        ("tangents up to 1e3", RANGE,
         partial(_alike, 13, 2, 100, near=0.01, spread=0.5, planes=24, extent=(-1e3, 1e3) * 2)),
    ]  # fmt: skip
    places: dict[str, Callable[[], Rays]] = {
        "points along rays and at infinity in 12 MPIs": partial(_anywhere, 120, 12, seed=14),
        "the same 1e6 units from the world's origin": partial(_anywhere, 120, 4, 8.0, 1e6, 15),
        "the same at scene scale 1e-4": partial(_anywhere, 120, 4, 1e-4, seed=16),
    }
    placed, inside = "(u, v, s) to 16 roundings, and inside or outside rightly", "exactly the samples inside"
    rows: list[tuple[str, str, Callable[[Precision], Outcome]]] = [
        ("2,400 random poses: 200 MPIs, 12 rays each", RANGE, _thousands),
        *((name, expectation, partial(measure_hits, rays)) for name, expectation, rays in hits),
        *((name, placed, partial(measure_places, rays)) for name, rays in places.items()),
        ("the cube: 300 rays through and past it", inside, partial(measure_cube, 1.0, False)),
        ("the cube: rays along its faces", inside, partial(measure_cube, 1.0, True)),
        ("the cube at scene scale 1e5", inside, partial(measure_cube, 1e5, False)),
    ]
    return [Case("geometry", *row) for row in rows]
