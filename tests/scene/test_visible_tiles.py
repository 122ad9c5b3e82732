"""Which tiles training rays can read: never fewer than rays through all pixels do, and not many more."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hand_made import make_mpi, rotation
from nerfstudio.cameras.cameras import Cameras, CameraType

from mmpi_ns.scene.geometry import Frames, plane_hits, sample_disparity
from mmpi_ns.scene.plan import CubePlan, ScenePlan
from mmpi_ns.scene.texels import BRICK, head_grids
from mmpi_ns.scene.visible_tiles import TrainingViews, reachable_tiles


def cameras(seed, count=3, lens=None, kind=CameraType.PERSPECTIVE, turn=0.3, focal=60.0):
    """Cameras near the world's origin that look along about +z."""
    rng = np.random.default_rng(seed)
    poses = np.zeros((count, 3, 4))
    for i in range(count):
        axes = np.array(rotation([1, *(rng.normal(size=3) * turn / 2)]))
        poses[i, :, :3] = axes @ np.diag([1.0, -1, -1])
        poses[i, :, 3] = rng.normal(size=3) * [0.5, 0.2, 1.5]
    return Cameras(
        camera_to_worlds=torch.tensor(poses, dtype=torch.float32),
        fx=focal, fy=focal, cx=31.0, cy=18.0, width=64, height=40,
        distortion_params=None if lens is None else torch.tensor(lens).expand(count, 6).clone(),
        camera_type=kind,
    )  # fmt: skip


def plan_around(seed):
    """MPIs that face the cameras' way, aslant and sideways, one of which begins among the cameras, and a cube."""
    rng = np.random.default_rng(seed)
    turns = ([1, 0, 0, 0], [1, *(rng.normal(size=3) * 0.2)], [1, 0, 0.9, 0.1])
    mpis = tuple(
        make_mpi(
            str(k),
            tuple(rng.normal(size=3) * 0.5),
            rotation(q),
            near=0.7 + k,
            extent=(-2.5, 2.6, -1.5, 1.4),
            planes=8,
            height=90,
            width=131,
        )
        for k, q in enumerate(turns)
    )
    return ScenePlan(mpis, CubePlan((-1.0, -1.0, 2.0), (1.0, 1.0, 4.0), (3, 9, 9)), 0.05, 1.0)


def read_tiles(bundle, plan, near=0.0):
    """Tiles of the MPIs that rays read."""
    frames, grids = Frames.pack(plan.mpis), head_grids(plan)
    o, d = bundle.origins.view(-1, 3), bundle.directions.view(-1, 3)
    hits = plane_hits(o, d, torch.full_like(o[:, :1], near), torch.full_like(o[:, :1], torch.inf), frames)
    actual = torch.zeros(len(grids[0].tiles), dtype=torch.bool)
    for k, mpi in enumerate(plan.mpis):
        for m in range(mpi.planes):
            intersected = (m <= hits.m_first[:, k]) & (m > hits.m_first[:, k] - hits.count[:, k])
            w = sample_disparity(torch.tensor(m), frames.disparity_steps[k], frames.last_disparities[k])
            u0, u1, v0, v1 = mpi.extent
            u = (hits.u[intersected, k, 0] + w * hits.u[intersected, k, 1] - u0) * (2 / (u1 - u0)) - 1
            v = (hits.v[intersected, k, 0] + w * hits.v[intersected, k, 1] - v0) * (2 / (v1 - v0)) - 1
            plane = torch.full_like(u, mpi.planes - 1 - m, dtype=torch.int64)
            rows, _ = grids[k].bilinear(plane, torch.stack([u, v], -1))
            actual[grids[k].places[rows // BRICK]] = True
    return actual


LENSES = {
    "none": (None, CameraType.PERSPECTIVE),
    "barrel": ([-0.2, 0.03, 0.0, 0.0, 0.002, -0.001], CameraType.PERSPECTIVE),
    "fisheye": ([0.02, -0.01, 0.0, 0.0, 0.0, 0.0], CameraType.FISHEYE),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lens", LENSES)
def test_every_tile_that_a_pixel_reads_is_reachable_and_few_others_are(lens, seed):
    params, kind = LENSES[lens]
    shot, plan = cameras(seed, lens=params, kind=kind), plan_around(seed)
    views = TrainingViews.of(shot)
    actual = reachable_tiles(views, plan)
    # Pixels, and half pixels between them: as dense as texels.
    y, x = torch.meshgrid(torch.arange(0, 40.01, 0.5), torch.arange(0, 64.01, 0.5), indexing="ij")
    grid = torch.stack([y, x], -1).reshape(-1, 2)
    index = torch.arange(3).repeat_interleave(len(grid))[:, None]
    wanted = read_tiles(shot.generate_rays(camera_indices=index, coords=grid.repeat(3, 1)), plan)
    mpis = len(actual) - 3 * 4
    assert wanted.any() and not wanted[mpis:].any() and actual[mpis:].all(), "the cube is all reachable"
    assert (actual | ~wanted).all()
    extra = (actual & ~wanted)[:mpis].sum() / mpis
    assert wanted[:mpis].float().mean() < 0.75 and extra < 0.06, (wanted[:mpis].float().mean(), extra)


def test_planes_that_every_camera_has_passed_are_out_of_reach():
    """Even where all they hold lies within the image that a camera would show of what is behind it."""
    shot, mpi = cameras(0, turn=0.0), make_mpi("passed", (0.0, 0.0, 0.0), rotation([1, 0, 0, 0]), near=0.7, planes=8)
    shot.camera_to_worlds[:, :, 3] = torch.tensor([0.0, 0.0, 2.0])
    actual = reachable_tiles(TrainingViews.of(shot), ScenePlan((mpi,), None, 0.05, 1.0))
    steps = torch.arange(mpi.planes - 1, -1, -1)
    depths = 1 / (1 / mpi.far + steps * mpi.disparity_step)
    ahead = actual.view(mpi.planes, -1).any(1)
    assert (depths < 2).any() and torch.equal(ahead, depths > 2)


@pytest.mark.parametrize("kind", [CameraType.EQUIRECTANGULAR, CameraType.FISHEYE])
def test_a_camera_that_sees_half_the_world_reaches_every_plane_before_it(kind):
    views, plan = TrainingViews.of(cameras(0, kind=kind, focal=15.0)), plan_around(0)  # 2.1 radians to each side
    assert not views.inward.any()
    shares = reachable_tiles(views, plan)[: 8 * 12 * 17].view(8, -1).float().mean(1).tolist()
    assert set(shares) <= {0.0, 1.0} and shares[-1] == 1
