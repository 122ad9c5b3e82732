"""How many pixels a texel spans: worked out by hand, for MPIs, finer copies and the cube."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle

from mmpi_ns.data.rays import image_rays
from mmpi_ns.rendering.rendered import winners
from mmpi_ns.scene.geometry import Frames
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan

LEVEL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
TURNED = ((0.6, 0.0, -0.8), (0.0, 1.0, 0.0), (0.8, 0.0, 0.6))


def told(heads, bundle, depths, accumulation):
    mpis = tuple(
        MPIPlan(f"mpi {k}", (0.0, 0.0, 0.0), axes, 1.0, (-1.0, 1.0, -0.25, 0.25), 8, 11, 21)
        for k, axes in enumerate((LEVEL, TURNED))
    )
    plan = ScenePlan(mpis, CubePlan((0.0, 0.0, 0.0), (1.0, 1.0, 3.0), (11, 11, 11)), 0.1, 1.0).with_copies()
    planned = lambda heads: torch.where(heads >= 2, heads - 2, heads)  # noqa: E731
    field = SimpleNamespace(plan=plan, layout=SimpleNamespace(frames=Frames.pack(plan.mpis)), planned_heads=planned)
    column = lambda values: torch.tensor(values)[:, None]  # noqa: E731
    outputs = {"winning_mpi": column(heads).short(), "depth": column(depths), "accumulation": column(accumulation)}
    return winners(outputs, bundle, field, 5)


def test_a_texel_spans_its_tangent_seen_from_its_mpi_and_more_from_nearer():
    """A texel is a tenth wide (a copy's half of it), so 10 pixels from the origin at any depth, 20 from half way."""
    heads, eyes = [2, 2, 2, 0, 3, 4, 2], [0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0]
    depths, accumulation = [1.5, 600.0, 3.0, 4.0, 2.0, 4.0, 1.0], [1.0, 1.0, 0.6, 1.0, 1.0, 1.0, 0.4]
    directions = torch.tensor([0.0, 0.0, 1.0]).expand(len(eyes), 3)
    origins = torch.tensor(eyes)[:, None] * directions
    bundle = RayBundle(origins, directions, torch.full((len(eyes), 1), 1e-4))  # 100 pixels a tangent
    result = told(heads, bundle, depths, accumulation)
    # The turned MPI's planes are 0.6 of the distance away; a voxel of 0.3 at a distance of 4; nothing is there.
    expected = torch.tensor([10.0, 10.0, 20.0, 5.0, 6.0, 7.5, 0.0])
    torch.testing.assert_close(result["texel_pixels"][:, 0], expected)
    assert result["winning_mpi"][:, 0].tolist() == [5, 5, 5, 5, 6, 7, 5]


def test_a_texel_of_a_plane_that_faces_the_camera_spans_as_many_pixels_at_the_border_of_the_image():
    pose = torch.tensor([[[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]])
    rays = image_rays(Cameras(pose, 100.0, 100.0, 50.0, 30.0, 100, 60)).flatten()
    count = len(rays.origins)
    result = told([2] * count, rays, torch.linspace(1, 9, count).tolist(), [1.0] * count)
    torch.testing.assert_close(result["texel_pixels"], torch.full((count, 1), 10.0), rtol=1e-4, atol=0)
