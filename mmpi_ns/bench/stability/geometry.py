"""Stability of the geometry: live planes, their (u, v) and 1/t, positions in other frames, the cube."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from mmpi_ns.bench.stability import exact
from mmpi_ns.bench.stability.cases import (
    UNIT,
    Case,
    Error,
    Outcome,
    Precision,
    as_array,
    compare,
    count_wrong,
    random_mpi,
    rays_at,
    single,
    snap,
)
from mmpi_ns.bench.stability.exact import Array
from mmpi_ns.scene.geometry import (
    Cube,
    Frames,
    PlaneHits,
    cube_hits,
    inverse_distance,
    plane_hits,
    sample_disparity,
    samples_to_ndc,
)
from mmpi_ns.scene.plan import CubePlan, MPIPlan, Vector

GROUP = "geometry"
ROUNDINGS = 16
"""Of (u, v), 1/t and what decides about a plane: 4 of a rotated offset, 3 of a rotated direction, a quotient of those,
a product and a sum, 4 of a disparity; docs/stability.md."""
LIVE = "exactly the live planes but where a border is within 16 roundings; (u, v) and 1/t to 16 roundings"
FORWARD = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
Rays = tuple[list[MPIPlan], Array, Array, float, float]
"""MPIs, origins and directions [R, 3], near, far."""


def front(near: float = 1.0, extent=(-1.0, 1.0, -0.5, 0.5), planes: int = 9, origin=(0.0, 0.0, 0.0)) -> MPIPlan:
    """An MPI that faces +z."""
    return snap(MPIPlan("front", origin, FORWARD, near, extent, planes, 5, 7))


def _hits(rays: Rays, precision: Precision) -> tuple[PlaneHits, Frames]:
    mpis, origins, directions, near, far = rays
    frames = Frames.pack(mpis)
    o, d = (torch.tensor(x, dtype=torch.float32) for x in (origins, directions))
    column = torch.ones(len(o), 1)
    with precision.context():
        return plane_hits(o, d, near * column, far * column, frames), frames


def measure_hits(rays: Rays, precision: Precision) -> Outcome:
    """Live planes, tangents and inverse distances of every ray in every MPI."""
    mpis, origins, directions, near, far = rays
    hits, frames = _hits(rays, precision)
    errors = [Error(0.0, ROUNDINGS * UNIT)]
    wrong = 0
    for k, mpi in enumerate(mpis):
        m = torch.arange(mpi.planes - 1, -1, -1).expand(len(origins), -1)
        first, count = hits.m_first[:, k, None], hits.count[:, k, None]
        live = ((m <= first) & (m > first - count)).numpy()
        w = sample_disparity(m, frames.disparity_steps[k], frames.last_disparities[k])
        u, v = (x[:, k, :1] + w * x[:, k, 1:] for x in (hits.u, hits.v))
        q = inverse_distance(w, hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:])
        u, v, q = (as_array(x) for x in (u, v, q))
        for i in range(len(origins)):
            wanted = exact.cross(mpi, origins[i], directions[i], near, far)
            clear = wanted.margin > ROUNDINGS * UNIT
            wrong += int((wanted.live != live[i])[clear].sum())
            both = wanted.live & live[i]
            for found, expected, size in (
                (u[i], wanted.u, wanted.size_uv),
                (v[i], wanted.v, wanted.size_uv),
                (q[i], wanted.inverse_t, wanted.size_q),
            ):
                errors.append(compare(found[both], expected[both], size[both], ROUNDINGS))
    return Outcome(Error.worst(errors) if not wrong else count_wrong(wrong))


def measure_places(rays: Rays, precision: Precision) -> Outcome:
    """Where points along rays lie in every MPI, and whether inside; points at infinity among them."""
    mpis, origins, directions, _, _ = rays
    rng = np.random.default_rng(1)
    reach = np.array([np.linalg.norm(o - np.array(mpis[0].origin)) for o in origins]) + mpis[0].near
    inverse_t = single(
        np.where(np.arange(len(origins)) % 4 == 0, 0, 1 / (reach * 10 ** rng.uniform(-1, 2, len(reach))))
    )
    o, d, q = (torch.tensor(x, dtype=torch.float32) for x in (origins, directions, inverse_t))
    with precision.context():
        ndc, inside = samples_to_ndc(o, d, q, Frames.pack(mpis))
    errors, wrong = [Error(0.0, ROUNDINGS * UNIT)], 0
    for i, k in np.ndindex(len(origins), len(mpis)):
        wanted = exact.place_in(mpis[k], origins[i], directions[i], float(inverse_t[i]))
        if wanted is None:
            wrong += bool(inside[i, k])
            continue
        place, size = wanted
        gap = float(np.abs(np.abs(place) - 1)[: 2 if inverse_t[i] == 0 else 3].min())
        if gap > 2 * ROUNDINGS * UNIT * size:
            wrong += bool(inside[i, k]) != bool((np.abs(place) <= 1).all())
        errors.append(compare(as_array(ndc[i, k]), place, size, ROUNDINGS))
    return Outcome(Error.worst(errors) if not wrong else count_wrong(wrong))


def _vector(x: Array) -> Vector:
    a, b, c = single(x)
    return float(a), float(b), float(c)


def measure_cube(precision: Precision, scale: float, parallel: bool) -> Outcome:
    """Samples inside the cube, for rays from inside, from outside, past it and along its faces."""
    rng = np.random.default_rng(2)
    lower, upper = (_vector(scale * np.array(x)) for x in ([-1.5, -1.2, -1.0], [1.4, 1.6, 2.0]))
    plan = CubePlan(lower, upper, (6, 5, 4))
    cube = Cube.pack(plan, 1.5)
    count = 300
    origins = single(rng.normal(size=(count, 3)) * 2 * scale)
    directions = rng.normal(size=(count, 3))
    if parallel:
        directions[np.arange(count), np.arange(count) % 3] = 0
        directions[::5, 1:] = 0
        directions[::5, 0] = 1
    directions = single(directions / np.linalg.norm(directions, axis=-1, keepdims=True))
    near = float(single(0.05 * scale))
    o, d = (torch.tensor(x, dtype=torch.float32) for x in (origins, directions))
    column = torch.ones(count, 1)
    with precision.context():
        first, number = cube_hits(o, d, near * column, math.inf * column, cube)
    wrong = 0
    for i in range(count):
        wanted, margin = exact.cube_steps(plan, cube.step, origins[i], directions[i], near, math.inf)
        found = list(range(int(first[i]), int(first[i] + number[i])))
        wrong += margin > 64 * UNIT and found != wanted
    return Outcome(count_wrong(wrong))


# The rays of each case -----------------------------------------------------------------------------------------------


def _random(count: int, per_plan: int, scale: float = 1.0, shift: float = 0.0, seed: int = 0, **changes) -> Rays:
    """Random MPIs, moved by ``shift`` and scaled about it, and rays into them; some of the rays miss."""
    rng = np.random.default_rng(seed)
    mpis = [random_mpi(rng, planes=int(rng.integers(2, 40)), **changes) for _ in range(per_plan)]
    mpis = [
        snap(replace(m, origin=tuple(shift + scale * x for x in m.origin), near=scale * m.near)) for m in mpis
    ]  # fmt: skip
    origins, directions = rays_at(rng, mpis, count)
    lost = rng.random(count) < 0.1
    directions[lost] = single(-directions[lost])
    return mpis, origins, directions, 0.05 * scale, math.inf


def _thousands(precision: Precision) -> Outcome:
    """2,400 poses: one random MPI and one ray for each dozen, so that frames vary as much as rays."""
    outcomes = [measure_hits(_random(12, 1, seed=s), precision) for s in range(200)]
    return Outcome(Error.worst([o.value for o in outcomes]))


def _towards(mpi: MPIPlan, origins, directions, near: float = 0.0, far: float = math.inf) -> Rays:
    d = np.atleast_2d(np.asarray(directions, np.float64))
    o = np.broadcast_to(np.atleast_2d(np.asarray(origins, np.float64)), (max(len(d), len(np.atleast_2d(origins))), 3))
    d = np.broadcast_to(d, o.shape)
    return [mpi], single(o), single(d / np.linalg.norm(d, axis=-1, keepdims=True)), near, far


def _nearly_parallel() -> Rays:
    slopes = 10.0 ** np.linspace(-6.5, -1, 56)
    directions = np.stack([np.cos(np.arange(56.0)), np.sin(np.arange(56.0)), slopes], -1)
    return _towards(front(extent=(-1e7, 1e7, -1e7, 1e7)), [[0.3, -0.2, 0.5]], directions)


def _behind(distance: float) -> Rays:
    rng = np.random.default_rng(3)
    targets = rng.uniform([-0.8, -0.4, 1], [0.8, 0.4, 1.0001], (64, 3)) * rng.uniform(1, 8, (64, 1))
    return _towards(front(), np.array([[0.0, 0.0, -distance]]), targets + np.array([0.0, 0.0, distance]))


def _on_planes() -> Rays:
    mpi, rng = front(planes=9), np.random.default_rng(4)
    depths = 8 / np.arange(8, 0, -1)
    origins = [[0.0, 0.0, z + step] for z in depths for step in (-1e-3, 0.0, 1e-3)]
    return _towards(mpi, origins, np.array([0, 0, 1]) + rng.normal(size=(len(origins), 3)) * 0.05)


def _grazing() -> Rays:
    """Rays from the MPI's own origin along the borders of its frustum and an ulp beside them."""
    edge = np.float32(1.0)
    tangents = [edge, np.nextafter(edge, np.float32(2)), np.nextafter(edge, np.float32(0)), -edge, 0.999, 1.001]
    return _towards(front(), [[0.0, 0.0, 0.0]], [[float(t), 0.3, 1.0] for t in tangents])


def _nearly_parallel_mpis() -> Rays:
    rng = np.random.default_rng(5)
    angle = 1e-6
    turned = ((1.0, 0.0, -angle), (0.0, 1.0, 0.0), (angle, 0.0, 1.0))
    mpis = [front(planes=33), snap(replace(front(planes=33, origin=(1e-6, 0.0, 1e-6)), axes=turned))]
    origins, directions = rays_at(rng, mpis, 128)
    return mpis, origins, directions, 0.05, math.inf


def _cases_of_rays() -> list[tuple[str, str, Callable[[], Rays]]]:
    wide = (-1e9, 1e9, -1e9, 1e9)
    flat = [[1, 0, 0], [0, -1, 0], [0.6, 0.8, 0], [1, 0, 1e-7], [1, 0, -1e-9]]
    rng = np.random.default_rng(6)
    cone = np.array([0, 0, 1]) + rng.normal(size=(64, 3)) * 0.2
    return [
        ("12 random MPIs, 200 rays", LIVE, lambda: _random(200, 12)),
        ("rays parallel to the planes (facing component 0, 1e-7, -1e-9)", "no live plane",
         lambda: _towards(front(extent=wide), [[0, 0, 0.5]], flat)),
        ("rays nearly parallel to the planes (facing component 3e-7 to 0.1)", LIVE, _nearly_parallel),
        ("rays that point away", "no live plane", lambda: _towards(front(), [[0, 0, 50], [0, 0, -5]] * 32, -cone)),
        ("camera on a plane, and 1e-3 before and past it", LIVE, _on_planes),
        ("camera past all finite planes (500 units)", "the plane at infinity alone, 1/t = 0",
         lambda: _towards(front(), [[0.2, 0.1, 500.0]], cone)),
        ("camera 1e6 units ahead of the MPI", "the plane at infinity alone, 1/t = 0",
         lambda: _towards(front(), [[3.0, -2.0, 1e6]], cone)),
        ("camera 1e3 units behind the MPI", LIVE, lambda: _behind(1e3)),
        ("camera 1e6 units behind the MPI", LIVE, lambda: _behind(1e6)),
        ("camera beside every frustum, looking in and looking past", LIVE,
         lambda: _towards(front(), [[-10, 0, 0]], cone + np.linspace(0, 2, 64)[:, None] * [1, 0, 0])),
        ("rays along the frustum's border, and one rounding beside it", LIVE, _grazing),
        ("finite far (9 units)", "no plane behind it, none at infinity",
         lambda: (*_random(200, 4, seed=7)[:3], 2.0, 9.0)),
        ("cameras and MPIs 1e6 units from the world's origin", LIVE, lambda: _random(200, 4, 8.0, 1e6, seed=8)),
        ("scene scale 1e-4", LIVE, lambda: _random(300, 4, 1e-4, seed=9)),
        ("scene scale 1e5", LIVE, lambda: _random(300, 4, 1e5, seed=10)),
        ("two MPIs turned by 1e-6 and moved by 1e-6 (nearly parallel planes)", LIVE, _nearly_parallel_mpis),
        ("MPIs that end at 1.5 times their near plane (bricks)", LIVE, lambda: _ending(1.5)),
        ("MPIs that end at 100 times their near plane", LIVE, lambda: _ending(100.0)),
        ("2 planes", LIVE, lambda: _with_planes(2)),
        ("4,096 planes", LIVE, lambda: _with_planes(4096)),
        ("a telephoto frustum (tangents +-1e-3)", LIVE, lambda: _with_extent(1e-3)),
        ("tangents up to 1e3", LIVE, lambda: _with_extent(1e3)),
    ]  # fmt: skip


def _with_planes(planes: int) -> Rays:
    rng = np.random.default_rng(12)
    mpis = [random_mpi(rng, planes) for _ in range(2)]
    return (mpis, *rays_at(rng, mpis, 60), 0.05, math.inf)


def _ending(factor: float) -> Rays:
    rng = np.random.default_rng(17)
    mpis = [random_mpi(rng, 24) for _ in range(3)]
    mpis = [snap(replace(m, far=factor * m.near)) for m in mpis]
    return (mpis, *rays_at(rng, mpis, 120), 0.05, math.inf)


def _with_extent(tangent: float) -> Rays:
    rng = np.random.default_rng(13)
    mpis = [random_mpi(rng, 24, extent=(-tangent, tangent, -tangent, tangent)) for _ in range(2)]
    return (mpis, *rays_at(rng, mpis, 100, spread=min(0.5, tangent / 4)), 0.01, math.inf)


def cases() -> list[Case]:
    """All cases of the geometry."""
    rows = [Case(GROUP, "2,400 random poses: 200 MPIs, 12 rays each", LIVE, _thousands)]
    for inputs, expectation, rays in _cases_of_rays():
        rows.append(Case(GROUP, inputs, expectation, lambda p, rays=rays: measure_hits(rays(), p)))
    places = "(u, v, s) to 16 roundings, and inside or outside rightly"
    for inputs, rays in (
        ("points along rays and at infinity in 12 MPIs", lambda: _random(120, 12, seed=14)),
        ("the same 1e6 units from the world's origin", lambda: _random(120, 4, 8.0, 1e6, seed=15)),
        ("the same at scene scale 1e-4", lambda: _random(120, 4, 1e-4, seed=16)),
    ):
        rows.append(Case(GROUP, inputs, places, lambda p, rays=rays: measure_places(rays(), p)))
    inside = "exactly the samples inside"
    rows.append(Case(GROUP, "the cube: 300 rays through and past it", inside, lambda p: measure_cube(p, 1.0, False)))
    rows.append(Case(GROUP, "the cube: rays along its faces", inside, lambda p: measure_cube(p, 1.0, True)))
    rows.append(Case(GROUP, "the cube at scene scale 1e5", inside, lambda p: measure_cube(p, 1e5, False)))
    return rows
