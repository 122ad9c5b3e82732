"""MPI frames and the cube: which planes and samples a ray meets, and where (geometry.py)."""

from __future__ import annotations

import math

import pytest
import torch
from hand_made import make_mpi, rays, world_to_ndc

from mmpi_ns.scene.geometry import Cube, Frames, cube_hits, inverse_distance, plane_hits, sample_disparity
from mmpi_ns.scene.plan import CubePlan

F64 = torch.float64


def intersected_planes(mpis, *ray, dtype=F64):
    """Live plane indices (0 nearest) of the first ray in each MPI."""
    frames = Frames.pack(mpis, dtype=dtype)
    hits = plane_hits(*ray, frames)
    return [
        [m.planes - 1 - int(hits.m_first[0, k]) + i for i in range(int(hits.count[0, k]))] for k, m in enumerate(mpis)
    ]


def hit_samples(frames, hits, k):
    """(ray, plane m, u, v, 1/t) of every intersected sample of MPI k."""
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
    assert intersected_planes([mpi], *rays(origin, direction, dtype=dtype), dtype=dtype) == [expected]


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
        assert intersected_planes([mpi], *rays([0, 0, 0], [0, 0, 1], near, far)) == [expected], (near, far)


def test_plane_at_infinity_is_hit_where_the_direction_points_into_the_frustum():
    mpi = make_mpi(extent=(-1.0, 1.0, -0.5, 0.5))
    far_away = [1e3, 1e3, 0]
    assert intersected_planes([mpi], *rays(far_away, [0.99, 0.49, 1])) == [[mpi.planes - 1]]
    assert intersected_planes([mpi], *rays(far_away, [1.01, 0.49, 1])) == [[]]
    assert mpi.planes - 1 not in intersected_planes([mpi], *rays([0, 0, 0], [0.1, 0, 1], far=1e12))[0]


def test_points_behind_an_mpi_are_outside_it_and_finite():
    frames = Frames.pack([make_mpi()], dtype=torch.float32)
    points = torch.tensor([[0.0, 0.0, -2.0], [1.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    ndc, inside = world_to_ndc(points, torch.tensor([1.0, 1.0, 0.0]), frames)
    assert not inside.any() and torch.isfinite(ndc).all()


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


# The cube ------------------------------------------------------------------------------------------------------------

BOX = CubePlan((-1.0, -2.0, -1.0), (1.0, 2.0, 3.0), (9, 9, 5))


def test_cube_step_is_the_shortest_voxel_side_over_the_samples_per_voxel():
    # Voxel sides: x 2/4, y 4/8, z 4/8.
    assert Cube.pack(BOX, 1.0).step == 0.5
    assert Cube.pack(CubePlan((0.0, 0.0, 0.0), (1.0, 2.0, 4.0), (3, 3, 3)), 2.0).step == 0.25
    corners = Cube.pack(BOX, 1.0, dtype=F64).normalised(
        torch.tensor([BOX.lower, BOX.upper, (0.0, 0.0, 1.0)], dtype=F64)
    )
    assert corners.tolist() == [[-1] * 3, [1] * 3, [0] * 3]


@pytest.mark.parametrize(
    ("origin", "direction", "near", "far", "expected"),
    [
        ([0, 0, 0], [1, 0, 0], 0, math.inf, [0, 1]),  # from inside: t = 0.25, 0.75
        ([-3, 0, 0], [1, 0, 0], 0, math.inf, [4, 5, 6, 7]),
        ([-3, 0, 0], [1, 0, 0], 2.3, 3.3, [5, 6]),
        ([-3, 0, 0], [-1, 0, 0], 0, math.inf, []),  # behind
        ([-3, 2.5, 0], [1, 0, 0], 0, math.inf, []),  # parallel, outside the slab
        ([-3, 2.0, 0], [1, 0, 0], 0, math.inf, [4, 5, 6, 7]),  # parallel, on the slab
        ([-3, 0, 0], [0, 1, 0], 0, math.inf, []),
    ],
)
def test_cube_hits_of_hand_made_rays(origin, direction, near, far, expected):
    first, count = cube_hits(*rays(origin, direction, near, far), Cube.pack(BOX, 1.0, dtype=F64))
    assert [int(first) + i for i in range(int(count))] == expected
