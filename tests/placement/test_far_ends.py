"""MPIs that end: what the field makes of them, and which ends placement gives them (placement/reach.py)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import oracle
import pytest
import torch
from hand_made import make_mpi, unit
from procedural import moved, observations_of
from random_fields import bundle, render

from mmpi_ns.field.mmpi_field import MMPIField, plane_biases
from mmpi_ns.placement.errors import pixel_errors
from mmpi_ns.placement.far_ends import _Ends, lattice_points, with_far_ends
from mmpi_ns.placement.observations import Observations
from mmpi_ns.placement.rule import PlacementConfig, place
from mmpi_ns.placement.visibility import find_visible_points
from mmpi_ns.scene.geometry import Frames, plane_hits
from mmpi_ns.scene.plan import ScenePlan
from mmpi_ns.synthetic.catalogue import make_scene

CONFIG = PlacementConfig(max_texels=0, max_mpis=1000, enough=1.0)
ENOUGH = CONFIG.enough * CONFIG.texel_pixels


# What the field makes of an end -------------------------------------------------------------------------------------


def test_an_mpi_that_ends_starts_as_one_to_infinity_without_its_last_planes():
    mpi = make_mpi(near=1.0, far=4.0, planes=25)  # disparities 1, 31/32, ..., 1/4: to infinity 8 more planes
    biases, interval = plane_biases(33)
    whole = oracle.composite((torch.nn.functional.softplus(biases.double()) * interval).tolist())
    field = MMPIField(ScenePlan((mpi,), None, 0.1, 1.0))
    taus = field.mpi_tau(0, torch.zeros(25), torch.arange(25)).double()
    ends = oracle.composite(taus.tolist())
    assert ends.weights == pytest.approx(whole.weights[:25], rel=1e-4)
    assert ends.transmittance == pytest.approx(8 / 33, rel=1e-4)


def test_a_ray_is_explained_only_where_some_mpi_reaches_to_infinity():
    def explained(*mpis):
        plan = ScenePlan(mpis, None, 0.05, content_near=1.5)
        alone = torch.ones(1, len(mpis), dtype=torch.bool)  # they train apart from others
        rays = bundle([[0, 0, 0]], [unit([0, 0, 1])])
        return bool(render(MMPIField(plan).eval(), rays, head_mask=alone).report.explained)

    near, whole, beyond = make_mpi(far=10.0), make_mpi(), make_mpi(near=9.0)
    assert explained(whole) and not explained(near)
    assert explained(near, beyond) and not explained(beyond)


def test_points_beyond_the_end_are_unserved_and_planes_lie_closer_before_it():
    observations = observations_of(make_scene("street"), per_camera=5)
    pose = observations.camera_to_worlds[0]
    axes = tuple(tuple(float(x) for x in row) for row in (pose[:, 0], -pose[:, 1], -pose[:, 2]))
    mpi = make_mpi(origin=tuple(map(float, pose[:, 3])), axes=axes, near=2.0, planes=64)
    points = pose[:, 3] - np.array([[5.0], [19.9], [20.1]]) * pose[:, 2]
    whole, ends = (
        pixel_errors(ScenePlan((m,), None, 0.1, 1.0), observations, np.array([3, 3, 3]), points).plane[:, 0]
        for m in (mpi, replace(mpi, far=20.0))
    )
    assert np.isfinite(whole).all() and np.isfinite(ends).tolist() == [True, True, False]
    assert ends[:2] == pytest.approx(0.9 * whole[:2])


# The choice, by hand ------------------------------------------------------------------------------------------------


def ends_of(bits, reach, met, lattice_reach, min_gain=1.0, held=True, least=None):
    bits, lattice_reach = np.array(bits, float), np.array(lattice_reach)
    lattice_held = np.full(lattice_reach.shape, held)
    weights = np.ones(bits.shape[1])
    least = np.zeros(len(bits), int) if least is None else np.array(least)
    met = np.array(met, float)
    return _Ends(bits, np.array(reach), weights, lattice_reach, lattice_held, met, least, min_gain).run()


MET = [[10, 20, 100], [10, 20, 100]]


def test_what_another_mpi_shows_as_well_is_given_up():
    # One observation near each, one far away that both show equally well.
    bits, reach = [[0, np.inf, 1], [np.inf, 0, 1]], [[0, 0, 2], [0, 0, 2]]
    assert sorted(ends_of(bits, reach, MET, [[0], [0]])) == [0, 2]


def test_what_no_other_shows_is_kept():
    bits, reach = [[0, np.inf, 1], [np.inf, 0, np.inf]], [[0, 0, 1], [0, 0, 0]]
    assert ends_of(bits, reach, MET, [[0], [0]]).tolist() == [1, 0]


def test_a_loss_is_taken_where_it_is_less_than_the_rays_it_spares_are_worth():
    def first(loss):  # the second MPI alone holds a point of the lattice far off, so only the first can end
        bits, reach = [[0, 0.0], [np.inf, loss]], [[0, 2], [0, 2]]
        return ends_of(bits, reach, MET, [[0], [2]], held=np.array([[False], [True]]))[0]

    # Ending the first at once spares 90 of the 100 rays that meet it: worth 0.9 of a bit.
    assert first(0.8) == 0 and first(1.0) == 2


def test_a_point_of_the_lattice_that_only_one_holds_keeps_it_long():
    bits, reach = [[0, np.inf], [np.inf, 0]], [[0, 0], [0, 0]]
    held = np.array([[True], [False]])
    assert ends_of(bits, reach, MET, [[2], [0]], held=held).tolist() == [2, 0]


def test_no_mpi_ends_before_its_first_plane():
    bits, reach = [[0, np.inf], [np.inf, 0]], [[0, 0], [0, 0]]
    assert ends_of(bits, reach, MET, [[0], [0]], least=[0, 1]).tolist() == [0, 1]


def test_an_end_that_spares_hardly_any_ray_is_not_made():
    bits, reach = [[0, np.inf], [np.inf, 0]], [[0, 0], [0, 0]]
    assert ends_of(bits, reach, [[95, 98, 100], [80, 98, 100]], [[0], [0]]).tolist() == [2, 0]


# The choice, on roads -----------------------------------------------------------------------------------------------


def mpis_met(plan: ScenePlan, observations: Observations) -> np.ndarray:
    """How many MPIs the rays of a lattice of pixels of every camera meet."""
    directions = lattice_points(observations, find_visible_points(observations))[2]
    origins = torch.from_numpy(np.repeat(observations.centers, directions.shape[1], 0))
    rays = torch.nn.functional.normalize(torch.from_numpy(directions.reshape(-1, 3)), dim=-1)
    near = torch.full((len(rays), 1), plan.ray_near, dtype=torch.float64)
    hits = plane_hits(origins, rays, near, near + torch.inf, Frames.pack(plan.mpis, dtype=torch.float64))
    return (hits.count > 0).sum(-1).numpy()


def ended(plan: ScenePlan, observations: Observations) -> ScenePlan:
    size = (ENOUGH, CONFIG.max_planes, CONFIG.min_gain)
    return replace(
        plan, mpis=tuple(with_far_ends(list(plan.mpis), observations, find_visible_points(observations), *size))
    )


@pytest.fixture(scope="module")
def roads() -> dict[int, tuple[Observations, ScenePlan, ScenePlan]]:
    result = {}
    for length in (250, 500):
        road = observations_of(make_scene("long-road", length=float(length)), per_camera=10)
        plan = place(road, CONFIG)
        result[length] = road, plan, ended(plan, road)
    return result


def test_most_mpis_of_a_road_end_and_rays_meet_far_fewer(roads):
    road, plan, ends = roads[500]
    before, after = mpis_met(plan, road), mpis_met(ends, road)
    assert sum(math.isinf(m.far) for m in ends.mpis) < 0.4 * len(ends.mpis)
    assert before.mean() > 0.8 * len(plan.mpis) and after.mean() < 0.5 * before.mean()
    assert after.min() > 0


def test_mpis_met_grow_much_less_than_the_road(roads):
    (short, _, short_ends), (long, _, long_ends) = roads[250], roads[500]
    assert len(long_ends.mpis) / len(short_ends.mpis) > 1.7
    assert mpis_met(long_ends, long).mean() < 1.55 * mpis_met(short_ends, short).mean()


def test_ends_leave_nothing_unheld_and_cost_little(roads):
    for road, plan, ends in roads.values():
        visible = find_visible_points(road)
        cameras, lattice, _ = lattice_points(road, visible)
        for where in ((visible.cameras, visible.points), (cameras, lattice)):
            held = [np.isfinite(pixel_errors(p, road, *where).combined.min(-1)) for p in (plan, ends)]
            assert (held[1] | ~held[0]).all()
        bits = []
        for p in (plan, ends):
            error = pixel_errors(p, road, visible.cameras, visible.points).combined.min(-1)
            bits.append(float(np.log2(np.clip(error, ENOUGH, 64) / ENOUGH) @ visible.weights))
        assert bits[1] - bits[0] < 0.05 * len(road.centers)
        assert bits[1] - bits[0] < CONFIG.min_gain * len(plan.mpis)


def test_ends_move_and_scale_with_the_scene(roads):
    road, plan, ends = roads[250]
    q, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    turn, shift, scale = q * np.sign(np.linalg.det(q)), np.array([100.0, -7.0, 3.0]), 0.037
    other = moved(road, turn, shift, scale)
    mpis = [
        replace(
            m,
            origin=tuple(map(float, scale * (turn @ m.origin) + shift)),
            axes=tuple(tuple(map(float, turn @ np.array(row))) for row in m.axes),
            near=scale * m.near,
        )
        for m in plan.mpis
    ]
    got = ended(replace(plan, mpis=tuple(mpis)), other)
    assert [m.far for m in got.mpis] == pytest.approx([scale * m.far for m in ends.mpis], rel=1e-6)


def test_the_numbering_of_cameras_and_keypoints_does_not_matter(roads):
    road, plan, ends = roads[250]
    rng = np.random.default_rng(4)
    cameras, keypoints = rng.permutation(len(road.centers)), rng.permutation(len(road.seen_by))
    shuffled = replace(
        road,
        camera_to_worlds=road.camera_to_worlds[cameras],
        intrinsics=road.intrinsics[cameras],
        sizes=road.sizes[cameras],
        seen_by=np.argsort(cameras)[road.seen_by][keypoints],
        seen_point=road.seen_point[keypoints],
        seen_at=road.seen_at[keypoints],
    )
    assert [m.far for m in ended(plan, shuffled).mpis] == [m.far for m in ends.mpis]


def test_one_mpi_reaches_to_infinity():
    plan = place(observations_of(make_scene("still-life")), replace(CONFIG, far_ends=True))
    assert [m.far for m in plan.mpis] == [math.inf]


def test_placement_gives_ends_where_asked(roads):
    road, plan, ends = roads[250]
    assert place(road, replace(CONFIG, far_ends=True)) == ends
    assert all(math.isinf(m.far) for m in plan.mpis)
