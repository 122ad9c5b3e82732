"""MPI frames: which planes a ray meets, and where (geometry.py)."""

from __future__ import annotations

import math

import numpy as np
import oracle
import pytest
import torch
from hand_made import (
    IDENTITY,
    directions,
    make_mpi,
    mpis,
    numbers,
    random_mpi,
    range_of,
    rays,
    rotations,
    samples_to_ndc,
    unit,
    vectors,
    world_to_ndc,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mmpi_ns.scene.geometry import (
    Frames,
    inverse_distance,
    plane_hits,
    sample_disparity,
)

F64 = torch.float64
BORDER = 1e-12
"""Planes closer to a border than this (relative) may fall on either side of it."""


def live_planes(mpis, *ray, dtype=F64):
    """Live plane indices (0 nearest) of the first ray in each MPI."""
    frames = Frames.pack(mpis, dtype=dtype)
    hits = plane_hits(*ray, frames)
    return [
        [m.planes - 1 - int(hits.m_first[0, k]) + i for i in range(int(hits.count[0, k]))] for k, m in enumerate(mpis)
    ]


def hit_samples(frames, hits, k):
    """(ray, plane m, u, v, 1/t) of every live sample of MPI k."""
    rows, columns = [], []
    for r in range(hits.count.shape[0]):
        for i in range(int(hits.count[r, k])):
            rows.append(r)
            columns.append(int(hits.m_first[r, k]) - i)
    r, m = torch.tensor(rows, dtype=torch.int64), torch.tensor(columns, dtype=torch.int64)
    w = sample_disparity(m, frames.disparity_steps[k], frames.last_disparities[k])
    u, v = (x[r, k, 0] + w * x[r, k, 1] for x in (hits.u, hits.v))
    return r, m, u, v, inverse_distance(w, hits.local_origins[r, k, 2], hits.local_directions[r, k, 2])


# Facts about single rays ---------------------------------------------------------------------------------------------


def test_planes_stand_at_even_disparities_from_near_to_infinity():
    mpi = make_mpi(near=2.0, planes=5)
    frames = Frames.pack([mpi], dtype=F64)
    w = sample_disparity(torch.arange(5), frames.disparity_steps, frames.last_disparities)
    assert w.tolist() == pytest.approx([0, 0.125, 0.25, 0.375, 0.5])
    assert w[0] == 0


def test_planes_of_an_mpi_that_ends_stand_at_even_disparities_from_near_to_far():
    frames = Frames.pack([make_mpi(near=2.0, far=10.0, planes=5)], dtype=F64)
    w = sample_disparity(torch.arange(5), frames.disparity_steps, frames.last_disparities)
    assert w.tolist() == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5])
    assert frames.depth_shares.tolist() == pytest.approx([0.8])


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ([0, 0, -1], [0, 0, 1], [0, 1, 2, 3, 4]),
        ([0, 0, 3], [0, 0, 1], [2, 3, 4]),
        ([0, 0, 9.99], [0, 0, 1], [4]),
        ([0, 0, 10.01], [0, 0, 1], []),  # beyond the far end
        ([0, 0, 1e9], [0.5, 0.2, 1], []),
        ([1e6, 0, 0], [0.5, 0, 1], []),  # one to infinity holds this ray's direction, not one that ends
        ([-3.5, 0, 4.9], [3, 0, 1], [3]),  # leaves at the side between depths 5 and 10
        ([0, 0, 5], [1, 0, 0], []),
        ([0, 0, 12], [0, 0, -1], []),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_rays_meet_an_mpi_that_ends_before_its_end_only(origin, direction, expected, dtype):
    mpi = make_mpi(near=2.0, far=10.0, planes=5)  # depths 2, 2.5, 10/3, 5, 10
    assert live_planes([mpi], *rays(origin, direction, dtype=dtype), dtype=dtype) == [expected]


def test_ndc_spans_near_to_far():
    frames = Frames.pack([make_mpi(near=2.0, far=10.0, extent=(-1.0, 3.0, -0.5, 0.5))], dtype=F64)
    points = torch.tensor([[0, 0, 2], [0, 0, 10], [0, 0, 10 / 3], [0, 0, 10.1], [0, 0, 1]], dtype=F64)
    ndc, inside = world_to_ndc(points, torch.tensor([1, 1, 1, 1, 0], dtype=F64), frames)
    assert torch.allclose(ndc[:3, 0, 2], torch.tensor([-1, 1, 0], dtype=F64))
    assert inside[:, 0].tolist() == [True, True, True, False, False]
    assert ndc[4, 0, 2].item() == pytest.approx(1.5)  # infinity lies as far beyond as 1/10 is of 0.4 half-ranges


def test_ray_along_the_axis_meets_every_plane_at_its_depth():
    mpi = make_mpi(near=2.0, planes=5)
    frames = Frames.pack([mpi], dtype=F64)
    ray = rays([0, 0, -1], [0, 0, 1])
    hits = plane_hits(*ray, frames)
    _, m, u, v, inverse_t = hit_samples(frames, hits, 0)
    assert m.tolist() == [4, 3, 2, 1, 0]
    assert (1 / inverse_t).tolist() == pytest.approx([3, 2 / 0.75 + 1, 5, 9, math.inf])
    assert u.tolist() == v.tolist() == [0.0] * 5
    assert inverse_t[-1] == 0


@pytest.mark.parametrize("direction", [[1, 0, 0], [0, -1, 0], [0.6, 0.8, 0], [1, 0, 1e-7]])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ray_parallel_to_planes_hits_nothing(direction, dtype):
    assert live_planes(
        [make_mpi(extent=(-1e9, 1e9, -1e9, 1e9))], *rays([0, 0, 0.5], direction, dtype=dtype), dtype=dtype
    ) == [[]]


@pytest.mark.parametrize("direction", [[0, 0, -1], [0.3, 0.1, -1], [1, 0, -1e-9]])
def test_ray_pointing_away_hits_nothing(direction):
    for origin in ([0, 0, -5], [0, 0, 0], [0, 0, 50]):
        assert live_planes([make_mpi()], *rays(origin, direction)) == [[]]


def test_ray_through_the_origin_of_an_mpi_has_the_same_tangents_on_every_plane():
    mpi = make_mpi(origin=(1.0, 2.0, 3.0))
    direction = unit([0.4, -0.2, 1])
    frames = Frames.pack([mpi], dtype=F64)
    hits = plane_hits(*rays(np.array(mpi.origin) - 2 * direction, direction), frames)
    _, _, u, v, _ = hit_samples(frames, hits, 0)
    assert hits.count.item() == mpi.planes
    assert torch.allclose(u, torch.full_like(u, 0.4), atol=1e-14) and torch.allclose(v, torch.full_like(v, -0.2))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_plane_that_the_camera_stands_on_is_not_hit_but_one_just_ahead_is(dtype):
    mpi = make_mpi(near=1.0, planes=5)  # depths 1, 4/3, 2, 4, infinity
    step = 1e-3 if dtype == torch.float32 else 1e-12
    for offset, expected in ((-step, [2, 3, 4]), (0.0, [3, 4]), (step, [3, 4])):
        ray = rays([0, 0, 2.0 + offset], [0, 0, 1], dtype=dtype)
        assert live_planes([mpi], *ray, dtype=dtype) == [expected], offset


def test_samples_stay_between_near_and_far():
    mpi = make_mpi(near=1.0, planes=5)
    for near, far, expected in (
        (0, math.inf, [0, 1, 2, 3, 4]),
        (1.5, math.inf, [2, 3, 4]),
        (0, 3.9, [0, 1, 2]),
        (1.1, 1.9, [1]),
        (2.5, 3.5, []),
        (1.2, 1.25, []),
    ):
        assert live_planes([mpi], *rays([0, 0, 0], [0, 0, 1], near, far)) == [expected], (near, far)


def test_plane_at_infinity_is_hit_where_the_direction_points_into_the_frustum():
    mpi = make_mpi(extent=(-1.0, 1.0, -0.5, 0.5))
    far_away = [1e3, 1e3, 0]
    assert live_planes([mpi], *rays(far_away, [0.99, 0.49, 1])) == [[mpi.planes - 1]]
    assert live_planes([mpi], *rays(far_away, [1.01, 0.49, 1])) == [[]]
    assert mpi.planes - 1 not in live_planes([mpi], *rays([0, 0, 0], [0.1, 0, 1], far=1e12))[0]


def test_ray_outside_every_frustum_hits_nothing():
    frames = [make_mpi(), make_mpi("right", axes=((0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)))]
    assert live_planes(frames, *rays([0, 0, 0], [0.3, 2, 1])) == [[], []]
    assert live_planes(frames, *rays([0, -30, 0], [0, -1, 0.1])) == [[], []]


def test_ray_grazes_a_frustum_in_a_middle_range_of_planes():
    # Crosses the slanted frustum |X/Z| <= 1 from the left border (at Z = 2) to the right one (at Z = 6).
    hits = live_planes([make_mpi(near=1.0, planes=25)], *rays([-5.0, 0, 0.5], [2, 0, 1]))
    depths = [24 / (24 - plane) for plane in hits[0]]
    assert hits[0] == [p for p in range(24) if abs(-5 + 2 * (24 / (24 - p) - 0.5)) <= 24 / (24 - p)]
    assert depths[0] == 2.0 and depths[-1] == 6.0


def test_ndc_of_hand_made_points():
    mpi = make_mpi(near=2.0, extent=(-1.0, 3.0, -0.5, 0.5))
    frames = Frames.pack([mpi], dtype=F64)
    points = torch.tensor([[0.0, 0.0, 2.0], [12.0, -2.0, 4.0], [1.0, 0.25, 1.0], [0.0, 0.0, 1.0]], dtype=F64)
    inverse_t = torch.tensor([1.0, 1.0, 0.0, 1.0], dtype=F64)
    ndc, inside = world_to_ndc(points, inverse_t, frames)
    expected = [[-0.5, 0, -1], [1, -1, 0], [0, 0.5, 1], [-0.5, 0, -3]]
    assert torch.allclose(ndc[:, 0], torch.tensor(expected, dtype=F64))
    assert inside[:, 0].tolist() == [True, True, True, False]


def test_points_behind_an_mpi_are_outside_it_and_finite():
    frames = Frames.pack([make_mpi()], dtype=torch.float32)
    points = torch.tensor([[0.0, 0.0, -2.0], [1.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    ndc, inside = world_to_ndc(points, torch.tensor([1.0, 1.0, 0.0]), frames)
    assert not inside.any() and torch.isfinite(ndc).all()


def test_frames_of_equal_axes_are_packed_in_order():
    frames = Frames.pack([make_mpi(near=1.0), make_mpi(near=4.0, planes=3, axes=IDENTITY)], dtype=F64)
    assert frames.disparity_steps.tolist() == [1 / 8, 1 / 8]
    assert frames.num_planes.tolist() == [9, 3] and frames.nears[1:].tolist() == [4.0]


# Against the oracle --------------------------------------------------------------------------------------------------


@settings(max_examples=300)
@given(mpi=mpis(), origin=vectors(), direction=directions(), near=st.just(0.0) | numbers(0, 5), data=st.data())
def test_live_interval_equals_testing_every_plane(mpi, origin, direction, near, data):
    far = data.draw(range_of(near))
    # Most rays should meet something: half of them start inside the frustum, at a random depth.
    if data.draw(st.booleans()):
        ndc = data.draw(vectors(3, 1.0))
        point, at_infinity = oracle.ndc_to_world(mpi, ndc)
        assume(not at_infinity)
        origin = point - direction * data.draw(numbers(0, 10))
    (found,) = live_planes([mpi], *rays(origin, direction, near, far))
    tested = oracle.crossings(mpi, origin, direction, near, far)
    expected = [c.plane for c in tested if c.live]
    undecided = {c.plane for c in tested if c.margin < BORDER}
    assert set(found) ^ set(expected) <= undecided
    assert expected == list(range(expected[0], expected[-1] + 1)) if expected and not undecided else True


@pytest.mark.parametrize("deep", [math.inf, 5.0])
@pytest.mark.parametrize("num_mpis", [1, 12])
def test_hits_of_many_mpis_equal_the_oracle(num_mpis, deep):
    rng = np.random.default_rng(num_mpis)
    plans = [random_mpi(rng, deep=deep) for _ in range(num_mpis)]
    ray = rays(rng.normal(size=(60, 3)) * 2, rng.normal(size=(60, 3)), near=0.1)
    frames = Frames.pack(plans, dtype=F64)
    hits = plane_hits(*ray, frames)
    found = 0
    for k, mpi in enumerate(plans):
        r, m, u, v, inverse_t = hit_samples(frames, hits, k)
        live = [(i, c) for i in range(60) for c in oracle.crossings(mpi, ray[0][i], ray[1][i], near=0.1) if c.live]
        assert [(int(a), mpi.planes - 1 - int(b)) for a, b in zip(r, m, strict=True)] == [(i, c.plane) for i, c in live]
        for values, name in ((u, "u"), (v, "v"), (inverse_t, "inverse_t")):
            wanted = torch.tensor([getattr(c, name) for _, c in live], dtype=F64)
            assert torch.allclose(values, wanted, rtol=1e-9, atol=1e-11), name
        found += len(live)
    assert found > 30 * num_mpis


@pytest.mark.parametrize("deep", [math.inf, 5.0])
def test_float32_ranges_differ_from_float64_only_at_borders(deep):
    rng = np.random.default_rng(0)
    plans = [random_mpi(rng, planes=1024, deep=deep) for _ in range(4)]
    ray = rays(rng.normal(size=(20_000, 3)), rng.normal(size=(20_000, 3)), near=0.05)
    exact, short = (
        plane_hits(*(x.to(dtype) for x in ray), Frames.pack(plans, dtype=dtype)) for dtype in (F64, torch.float32)
    )
    assert exact.count.sum() > (5_000_000 if math.isinf(deep) else 2_000_000)
    differ = (exact.count != short.count) | ((exact.m_first != short.m_first) & (exact.count > 0))
    assert differ.sum() <= 20
    for r, k in differ.nonzero().tolist():
        sets = [{int(h.m_first[r, k]) - i for i in range(int(h.count[r, k]))} for h in (exact, short)]
        for m in sets[0] ^ sets[1]:
            plane = plans[k].planes - 1 - m
            assert oracle.cross_plane(plans[k], plane, ray[0][r], ray[1][r], 0.05, math.inf).margin < 1e-6


@settings(max_examples=150)
@given(
    mpi=mpis(), origin=vectors(), direction=directions(), turn=rotations(), shift=vectors(3, 50.0),
    scale=st.sampled_from([1e-4, 0.3, 7.0, 1e5]),
)  # fmt: skip
def test_rigid_motion_and_scaling_of_the_scene_change_nothing(mpi, origin, direction, turn, shift, scale):
    turn = np.array(turn)
    moved = make_mpi(
        origin=tuple(map(float, scale * (turn @ np.array(mpi.origin) + shift))),
        axes=tuple(tuple(map(float, turn @ np.array(row))) for row in mpi.axes),
        near=mpi.near * scale,
        far=mpi.far * scale,
        extent=mpi.extent,
        planes=mpi.planes,
    )
    before, after = (Frames.pack([m], dtype=F64) for m in (mpi, moved))
    ray = rays(origin, direction, near=0.1)
    moved_ray = rays(scale * (turn @ origin + shift), turn @ direction, near=0.1 * scale)
    margin = min(c.margin for c in oracle.crossings(mpi, origin, direction, near=0.1))
    assume(margin > 1e-10)  # rotating rounds, so a plane on a border may change sides
    a, b = plane_hits(*ray, before), plane_hits(*moved_ray, after)
    assert a.count.item() == b.count.item()
    if a.count.item():
        _, m, u, v, inverse_t = hit_samples(before, a, 0)
        _, m2, u2, v2, inverse_t2 = hit_samples(after, b, 0)
        reach = 1 + np.linalg.norm(shift) + np.linalg.norm(origin) + np.linalg.norm(mpi.origin)
        slack = 1e-12 * reach / mpi.near / float(a.local_directions[0, 0, 2]) ** 2
        assert torch.equal(m, m2)
        assert torch.allclose(u, u2, atol=slack, rtol=0) and torch.allclose(v, v2, atol=slack, rtol=0)
        # 1/t has a pole at the camera: compare w / (1 - w oz) where it is no larger than a plane's own 1/t.
        usual = inverse_t < 10 / mpi.near
        assert torch.allclose(inverse_t[usual], inverse_t2[usual] * scale, atol=100 * slack, rtol=1e-6)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_scene_scale_changes_nothing_in_float32(scale):
    rng = np.random.default_rng(5)
    mpi = random_mpi(rng, planes=64)
    origins, dirs = rng.normal(size=(500, 3)), rng.normal(size=(500, 3))
    unscaled = plane_hits(*rays(origins, dirs, near=0.05), Frames.pack([mpi], dtype=F64))
    scaled = make_mpi(
        origin=tuple(scale * x for x in mpi.origin), axes=mpi.axes, near=scale * mpi.near, extent=mpi.extent, planes=64
    )
    hits = plane_hits(
        *rays(scale * origins, dirs, near=0.05 * scale, dtype=torch.float32), Frames.pack([scaled], dtype=torch.float32)
    )
    assert unscaled.count.sum() > 1500
    # A single plane in 500 x 64 may lie within rounding of a border.
    assert (unscaled.count - hits.count).abs().sum() <= 2
    assert (unscaled.m_first - hits.m_first)[unscaled.count > 0].abs().sum() <= 2


@settings(max_examples=150)
@given(mpi=mpis(), ndc=vectors(3, 1.0), at_infinity=st.booleans())
def test_ndc_of_world_points_undoes_the_oracle(mpi, ndc, at_infinity):
    if at_infinity or ndc[2] > 1 - 1e-12:  # nearer than rounding tells apart
        ndc[2] = 1.0
    frames = Frames.pack([mpi], dtype=F64)
    given_ndc = torch.tensor(ndc, dtype=F64)[None]
    point, is_direction = oracle.ndc_to_world(mpi, ndc)
    assert is_direction == (ndc[2] == 1 and math.isinf(mpi.far))
    inverse_t = torch.tensor([0.0 if is_direction else 1.0], dtype=F64)
    back, inside = world_to_ndc(torch.tensor(point, dtype=F64)[None], inverse_t, frames)
    # The world point is a rounded sum with the origin, and what lies between near and far may be a sliver of the world.
    slack = 1e-12 * (1 + np.abs(mpi.origin).max() / mpi.near) / mpi.depth_share
    assert inside.item() or np.abs(ndc).max() > 1 - slack
    assert torch.allclose(back[0, 0], given_ndc[0], rtol=0, atol=slack)


def test_ndc_of_samples_equals_the_oracle_in_every_mpi():
    rng = np.random.default_rng(8)
    plans = [random_mpi(rng, deep=deep) for deep in (math.inf, math.inf, 8.0, 2.0, 30.0)]
    origins, dirs, *_ = rays(rng.normal(size=(200, 3)), rng.normal(size=(200, 3)))
    inverse_t = torch.tensor(rng.uniform(0.01, 2, size=200), dtype=F64)
    inverse_t[::7] = 0
    ndc, inside = samples_to_ndc(origins, dirs, inverse_t, Frames.pack(plans, dtype=F64))
    short, _ = samples_to_ndc(origins.float(), dirs.float(), inverse_t.float(), Frames.pack(plans, dtype=torch.float32))
    homogeneous, _ = world_to_ndc(origins * inverse_t[:, None] + dirs, inverse_t, Frames.pack(plans, dtype=F64))
    for i in range(200):
        for k, mpi in enumerate(plans):
            wanted = oracle.ray_point_to_ndc(mpi, origins[i], dirs[i], float(inverse_t[i]))
            assert bool(inside[i, k]) == oracle.covers(mpi, origins[i], dirs[i], float(inverse_t[i]))
            if wanted is not None:
                assert np.allclose(ndc[i, k], wanted, rtol=1e-9, atol=1e-9)
                assert np.allclose(homogeneous[i, k], wanted, rtol=1e-9, atol=1e-9)
            if inside[i, k]:
                assert np.abs(short[i, k].numpy() - wanted).max() < 2e-5
    assert 20 < inside.sum() < 900


def test_rays_far_from_the_worlds_origin_keep_float32_precision():
    """A 10 km drive: differences to the MPI's origin are taken first, so only the local geometry rounds."""
    rng = np.random.default_rng(6)
    axes = random_mpi(rng).axes
    home = make_mpi(axes=axes, planes=65)
    away = make_mpi(origin=(8192.0, -4096.0, 512.0), axes=axes, planes=65)
    # Multiples of 2^-9, so that adding the origin is exact in float32 and both scenes are the same.
    origins = np.round(rng.uniform(-1, 1, size=(200, 3)) * 512) / 512
    targets = np.array([oracle.ndc_to_world(home, rng.uniform(-0.9, 0.5, size=3))[0] for _ in range(200)])
    seen = []
    for mpi in (home, away):
        frames = Frames.pack([mpi], dtype=torch.float32)
        ray = rays(origins + np.array(mpi.origin), targets - origins, dtype=torch.float32)
        hits = plane_hits(*ray, frames)
        r, m, u, v, inverse_t = hit_samples(frames, hits, 0)
        ndc, inside = samples_to_ndc(ray[0][r], ray[1][r], inverse_t, frames)
        assert inside.all() and len(r) > 2000
        assert torch.allclose(ndc[:, 0, 2], 1 - 2 * m.float() / 64, atol=2e-6)
        seen.append(torch.stack([u, v, inverse_t, ndc[:, 0, 0], ndc[:, 0, 1]]))
    assert torch.equal(*seen)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_plane_exactly_at_near_or_far_is_kept(dtype):
    """Division finds the range only to one plane; whether a plane at the border is in it, its own distance decides."""
    for planes in range(2, 130):
        frames = Frames.pack([make_mpi(planes=planes)], dtype=dtype)
        w = sample_disparity(torch.arange(1, planes), frames.disparity_steps, frames.last_disparities)
        distance = (1 / w)[:, None]
        o, d, zeros, infinite = (x.expand(planes - 1, -1) for x in rays([0, 0, 0], [0, 0, 1], dtype=dtype))
        to_far = plane_hits(o, d, zeros, distance, frames)
        last = to_far.m_first - to_far.count + 1
        kept = w >= 1 / distance[:, 0]
        assert torch.equal(last[:, 0], torch.arange(1, planes) + (~kept).long())
        from_near = plane_hits(o, d, distance, infinite, frames)
        assert torch.equal(from_near.m_first[:, 0], torch.arange(1, planes) - (w * distance[:, 0] > 1).long())
