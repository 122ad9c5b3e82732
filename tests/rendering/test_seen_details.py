"""Details of an image at the surfaces of rays against single rays in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from mmpi_ns.data.rays import image_rays
from mmpi_ns.rendering.details import FADE, HERE, MIDDLE, SAME_DEPTH, SAME_PIXELS, TURN, project, seen_details

LENS = [0.08, -0.02, 0.004, 0.0, 0.003, -0.002]
HEIGHT, WIDTH = 20, 28
KINDS = [CameraType.PERSPECTIVE, CameraType.FISHEYE]


def camera(x=0.0, y=0.0, z=0.0, turn=0.0, kind=CameraType.PERSPECTIVE, lens=None) -> Cameras:
    """At a place, turned about the vertical axis by an angle."""
    c, s = math.cos(turn), math.sin(turn)
    pose = torch.tensor([[c, 0, s, x], [0, 1, 0, y], [-s, 0, c, z]])
    lens = None if lens is None else torch.tensor([lens])
    return Cameras(pose[None], 22.0, 21.0, 14.5, 9.0, WIDTH, HEIGHT, lens, camera_type=kind)


def numbers(cameras: Cameras, reach=10.0) -> torch.Tensor:
    lens = torch.zeros(6) if cameras.distortion_params is None else cameras.distortion_params.reshape(-1)
    fisheye = float(int(cameras.camera_type) == CameraType.FISHEYE.value)
    intrinsics = [float(x) for x in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)]
    return torch.cat(
        [cameras.camera_to_worlds.reshape(-1), torch.tensor([*intrinsics, *lens.tolist(), fisheye, reach])]
    )


def random_image(seed: int, depth: float) -> torch.Tensor:
    """Values, and inverse depths about a depth, of which every fifth is masked."""
    g = torch.Generator().manual_seed(seed)
    difference, near = torch.randn(HEIGHT, WIDTH, 3, generator=g), torch.rand(HEIGHT, WIDTH, 1, generator=g)
    inverse = torch.where(torch.rand(HEIGHT, WIDTH, 1, generator=g) < 0.2, -1.0, near * 0.1 + 1 / depth)
    return torch.cat([difference, inverse], -1)


def bilinear(image, x, y):
    """Values at a pixel coordinate (centres at halves); beyond the outermost centres those of the border."""
    x, y = min(max(x - 0.5, 0), WIDTH - 1), min(max(y - 0.5, 0), HEIGHT - 1)
    x0, y0 = min(int(x), WIDTH - 2), min(int(y), HEIGHT - 2)
    a, b = x - x0, y - y0
    above = (1 - a) * image[y0, x0] + a * image[y0, x0 + 1]
    return (1 - b) * above + b * ((1 - a) * image[y0 + 1, x0] + a * image[y0 + 1, x0 + 1])


def oracle(cameras, image, origin, direction, inverse, radiance):
    """Weight and weighted difference of one ray."""
    pose = cameras.camera_to_worlds[0].double().numpy()
    relative = inverse * (origin - pose[:, 3]) + direction
    length = np.linalg.norm(relative)
    right, up, back = pose[:, :3].T @ relative
    if int(cameras.camera_type) == CameraType.FISHEYE.value:
        radius = math.hypot(right, up)
        u, v = np.array([right, -up]) * (math.atan2(radius, -back) / max(radius, 1e-12))
    elif back >= 0:
        return 0.0, np.zeros(3)
    else:
        u, v = right / -back, -up / -back
    if cameras.distortion_params is not None:
        k1, k2, k3, k4, p1, p2 = (float(k) for k in cameras.distortion_params[0])
        r = u * u + v * v
        radial = 1 + k1 * r + k2 * r**2 + k3 * r**3 + k4 * r**4
        u, v = (
            radial * u + 2 * p1 * u * v + p2 * (r + 2 * u * u),
            radial * v + 2 * p2 * u * v + p1 * (r + 2 * v * v),
        )
    x, y = float(cameras.fx) * u + float(cameras.cx), float(cameras.fy) * v + float(cameras.cy)
    if not (0 < x < WIDTH and 0 < y < HEIGHT):
        return 0.0, np.zeros(3)
    *difference, there = bilinear(image.double().numpy(), x, y)
    if there < 0:
        return 0.0, np.zeros(3)
    here, baseline = inverse / length, np.linalg.norm(origin - pose[:, 3])
    margin = SAME_DEPTH * max(there, here) + SAME_PIXELS / max(float(cameras.fx) * baseline, 1e-9)
    turn = np.linalg.norm(relative / length - direction)
    weight = math.exp(-min(((there - here) / margin) ** 2, 80)) / (turn + TURN) / max(length, 1) ** 4
    difference = np.array(difference) - HERE * (radiance - MIDDLE)
    return weight, weight * difference / (1 + (turn / FADE) ** 2)


@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("depth", [0.3, 4.0, 1e6, math.inf])
@pytest.mark.parametrize(
    "place",
    [(0.2, 0, 0, 0.1), (0, 0, 0, 0), (-0.1, 0.1, 0.3, -0.2), (0, 0, 0, math.pi), (0, 0, -1.0, 0), (1e4, 0, 0, 0)],
)
def test_details_are_those_of_single_rays(place, depth, kind, lens):
    """Of surfaces near, far and at infinity, by images from beside, from the same place, turned away, behind the
    surface, and far away."""
    cameras, image = camera(*place, kind=kind, lens=lens), random_image(1, depth)
    rays = image_rays(camera(kind=kind, lens=lens)).flatten()
    inverse = torch.full((len(rays), 1), 1 / depth)
    radiance = torch.rand(len(rays), 3, generator=torch.Generator().manual_seed(2))
    difference, weight = seen_details(rays.origins, rays.directions, inverse, radiance, image, numbers(cameras))
    assert torch.isfinite(difference).all() and torch.isfinite(weight).all()
    expected = [
        oracle(cameras, image, o, d, 1 / depth, field)
        for o, d, field in zip(*(x.double().numpy() for x in (rays.origins, rays.directions, radiance)), strict=True)
    ]
    weights, products = np.array([w for w, _ in expected]), np.stack([product for _, product in expected])
    # In one arithmetic a pixel may lie in the image, or between masked ones, and just outside in the other.
    wrong = np.abs(weight[:, 0].numpy() - weights) > 2e-3 * weights + 0.01
    wrong |= np.abs((weight * difference).numpy() - products).max(-1) > 0.01 * weights + 0.02
    assert wrong.mean() < 0.01


@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize("kind", KINDS)
def test_rays_of_pixels_project_to_their_centres(kind, lens):
    cameras = camera(0.3, -0.2, 1.0, 0.4, kind, lens)
    rays = image_rays(cameras).flatten()
    pixels, inside = project(rays.directions @ cameras.camera_to_worlds[0, :, :3], numbers(cameras), HEIGHT, WIDTH)
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    assert bool(inside.all())
    assert torch.allclose(pixels, torch.stack([x, y], -1).view(-1, 2), atol=2e-2)


def test_directions_that_a_lens_folds_back_are_outside():
    """A strong lens brings directions far outside of the image back into it."""
    cameras = camera(lens=[-0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    wide, image = torch.tensor([[1.8, 0.0, -1.0]]), torch.ones(HEIGHT, WIDTH, 4)
    assert 0 < 22 * 1.8 * (1 - 0.3 * 1.8**2) + 14.5 < WIDTH, "the test's direction does not fold"
    ray = torch.zeros(1, 3), torch.nn.functional.normalize(wide), torch.ones(1, 1), torch.zeros(1, 3), image
    assert float(seen_details(*ray, numbers(cameras, reach=10.0))[1]) > 1
    assert float(seen_details(*ray, numbers(cameras, reach=0.9))[1]) == 0


def test_an_image_of_one_pixel_and_no_rays():
    cameras, one = numbers(camera()), torch.tensor([[[0.1, 0.2, 0.3, 0.25]]])
    ray = torch.zeros(1, 3), torch.nn.functional.normalize(torch.tensor([[-0.64, 0.4, -1.0]])), torch.full((1, 1), 0.25)
    ray = *ray, torch.full((1, 3), MIDDLE)
    assert torch.allclose(seen_details(*ray, one, cameras)[0], one[0, :, :3])
    nothing = torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 1), torch.zeros(0, 3)
    assert seen_details(*nothing, one, cameras)[1].shape == (0, 1)
