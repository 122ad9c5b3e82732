"""Details of training images against a float64 oracle, a ray at a time, and what must not show: what other surfaces
have, what is masked, and the details of another checkpoint."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras, CameraType

from mmpi_ns.capture.rays import image_rays
from mmpi_ns.rendering.details import (
    LARGEST,
    LEAST,
    LEVELS,
    SAME_DEPTH,
    SAME_PIXELS,
    STRENGTH,
    TURN,
    Details,
    DetailView,
    blended_details,
    details_of,
    moved_cameras,
    write_details,
)
from mmpi_ns.utils.errors import InputError

LENS = [0.08, -0.02, 0.004, 0.0, 0.003, -0.002]
HEIGHT, WIDTH = 20, 28


def camera(x=0.0, y=0.0, z=0.0, turn=0.0, kind=CameraType.PERSPECTIVE, lens=None) -> Cameras:
    """At a place, turned about the vertical axis by an angle."""
    c, s = math.cos(turn), math.sin(turn)
    pose = torch.tensor([[c, 0, s, x], [0, 1, 0, y], [-s, 0, c, z]])
    lens = None if lens is None else torch.tensor([lens])
    return Cameras(pose[None], 22.0, 21.0, 14.5, 9.0, WIDTH, HEIGHT, lens, camera_type=kind)


def view_of(cameras: Cameras, planes: torch.Tensor, reach=10.0) -> DetailView:
    pose, lens = cameras.camera_to_worlds[0], cameras.distortion_params
    intrinsics = torch.cat([x.reshape(1) for x in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)])
    fisheye = int(cameras.camera_type) == CameraType.FISHEYE.value
    return DetailView(pose, intrinsics, torch.zeros(6) if lens is None else lens.reshape(-1), fisheye, reach, planes)


def random_planes(seed: int, depth: float) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    difference = torch.randn(3, HEIGHT, WIDTH, generator=g) * 0.1
    return torch.cat([difference, torch.rand(1, HEIGHT, WIDTH, generator=g) * 0.1 + 1 / depth])


def bilinear(planes, x, y):
    """Values at a pixel coordinate (centres at halves); beyond the outermost centres those of the border."""
    x, y = min(max(x - 0.5, 0), WIDTH - 1), min(max(y - 0.5, 0), HEIGHT - 1)
    x0, y0 = min(int(x), WIDTH - 2), min(int(y), HEIGHT - 2)
    a, b = x - x0, y - y0
    p = planes
    top = (1 - a) * p[:, y0, x0] + a * p[:, y0, x0 + 1]
    return (1 - b) * top + b * ((1 - a) * p[:, y0 + 1, x0] + a * p[:, y0 + 1, x0 + 1])


def oracle(views, shares, origin, direction, inverse):
    """What ``blended_details`` gives for one ray."""
    total, weight = np.zeros(3), LEAST
    for cameras, planes, share in zip(*views, shares, strict=True):
        pose = cameras.camera_to_worlds[0].double().numpy()
        relative = inverse * (origin - pose[:, 3]) + direction
        length = np.linalg.norm(relative)
        right, up, back = pose[:, :3].T @ relative
        if int(cameras.camera_type) == CameraType.FISHEYE.value:
            radius = math.hypot(right, up)
            u, v = np.array([right, -up]) * (math.atan2(radius, -back) / max(radius, 1e-12))
        elif back >= 0:
            continue
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
            continue
        *difference, there = bilinear(planes.double().numpy(), x, y)
        if there < 0:
            continue
        here = inverse / length
        baseline = np.linalg.norm(origin - pose[:, 3])
        margin = SAME_DEPTH * max(there, here) + SAME_PIXELS / max(float(cameras.fx) * baseline, 1e-9)
        turn = np.linalg.norm(relative / length - direction)
        w = share * math.exp(-(((there - here) / margin) ** 2)) / (turn + TURN)
        total, weight = total + w * np.array(difference), weight + w
    return STRENGTH * total / weight


@pytest.mark.parametrize(
    ("kind", "lens"),
    [
        (CameraType.PERSPECTIVE, None),
        (CameraType.PERSPECTIVE, LENS),
        (CameraType.FISHEYE, None),
        (CameraType.FISHEYE, LENS),
    ],
)
@pytest.mark.parametrize("depth", [0.3, 4.0, 1e6, math.inf])
def test_blended_details_are_those_of_the_oracle(kind, lens, depth):
    """Near, far and infinite surfaces; views beside, in the same place, turned away, and behind the surface."""
    places = [(0.2, 0, 0, 0.1), (0, 0, 0, 0), (-0.1, 0.1, 0.3, -0.2), (0, 0, 0, math.pi), (0, 0, -1.0, 0)]
    views = [camera(*place, kind=kind, lens=lens) for place in places]
    planes = [random_planes(i, depth) for i in range(len(places))]
    shares = [1.0, 0.8, 0.5, 0.7, 0.3]
    rays = image_rays(camera(kind=kind, lens=lens)).flatten()
    distances = torch.full((len(rays), 1), depth)
    result = blended_details(
        [view_of(*pair) for pair in zip(views, planes, strict=True)], shares, rays.origins, rays.directions, distances
    )
    expected = [
        oracle((views, planes), shares, o, d, 1 / depth)
        for o, d in zip(rays.origins.double().numpy(), rays.directions.double().numpy(), strict=True)
    ]
    assert torch.isfinite(result).all()
    # A pixel whose coordinate lies on the image's border in one arithmetic and beside it in the other may differ.
    wrong = np.abs(result.numpy() - np.array(expected)).max(-1) > 2e-4
    assert wrong.mean() < 0.01


@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize("kind", [CameraType.PERSPECTIVE, CameraType.FISHEYE])
def test_rays_of_pixels_project_to_their_centres(kind, lens):
    cameras = camera(0.3, -0.2, 1.0, 0.4, kind, lens)
    rays, view = image_rays(cameras).flatten(), view_of(cameras, torch.zeros(4, HEIGHT, WIDTH))
    pixels, inside = view.project(rays.directions @ view.pose[:, :3])
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    assert bool(inside.all())
    assert torch.allclose(pixels, torch.stack([x, y], -1).view(-1, 2), atol=2e-2)


def test_directions_that_a_lens_folds_back_are_outside():
    """A strong lens brings directions far outside of the image back into it."""
    cameras = camera(lens=[-0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    view = view_of(cameras, torch.zeros(4, HEIGHT, WIDTH), reach=0.9)
    wide = torch.tensor([[1.8, 0.0, -1.0]])
    radius = 1.8 * (1 - 0.3 * 1.8**2)
    assert 0 < 22 * radius + 14.5 < WIDTH, "the test's direction does not fold"
    assert not bool(view.project(wide)[1])


def write(folder, cameras, planes, mask=None, step=7, factors=()):
    """Details of images that are gray, and renderings that differ from them by ``planes``."""

    def image_of(i):
        usable = np.ones((HEIGHT, WIDTH), np.uint8) if mask is None else mask
        return np.full((HEIGHT, WIDTH, 3), 128, np.uint8), usable

    rendered = iter(planes)

    def outputs_of(bundle):
        part = next(rendered)
        factor = torch.tensor(factors[0]) if len(factors) else torch.ones(3)
        return {"radiance": (128 / 255 - part[:3].movedim(0, -1) * factor) / factor, "depth": 1 / part[3][..., None],
                "rgb": torch.zeros(HEIGHT, WIDTH, 3)}  # fmt: skip

    return write_details(folder, step, cameras, torch.tensor(factors), image_of, outputs_of)


def joined(*cameras: Cameras) -> Cameras:
    poses = torch.cat([c.camera_to_worlds for c in cameras])
    return Cameras(poses, 22.0, 21.0, 14.5, 9.0, WIDTH, HEIGHT)


def test_what_is_written_is_read(tmp_path):
    """Within half a level, and depths to half precision."""
    planes = [random_planes(i, 4.0) for i in range(3)]
    cameras = joined(camera(), camera(0.3), camera(0.6, turn=0.2))
    assert "Details of 3 training images" in write(tmp_path, cameras, planes, factors=[[0.8, 1.0, 1.2]] * 3)
    details = Details(tmp_path)
    for i, expected in enumerate(planes):
        view = details.view(i, torch.device("cpu"))
        assert torch.allclose(view.pose, cameras.camera_to_worlds[i])
        assert (view.planes[:3] - expected[:3]).abs().max() <= 0.5 * LARGEST / LEVELS + 1e-4
        assert torch.allclose(view.planes[3], expected[3], rtol=1e-3)


def test_an_image_at_a_training_camera_gets_its_details(tmp_path):
    planes = [random_planes(0, 4.0)]
    write(tmp_path, joined(camera()), planes)
    bundle = image_rays(camera())
    outputs = {"depth": 1 / planes[0][3][..., None], "accumulation": torch.ones(HEIGHT, WIDTH, 1),
               "rgb": torch.full((HEIGHT, WIDTH, 3), 0.5)}  # fmt: skip
    shown = Details(tmp_path).added(outputs, bundle, 4, None)
    expected = STRENGTH * planes[0][:3].movedim(0, -1)
    assert torch.allclose(shown["detail"], expected, atol=4e-3)
    assert torch.allclose(shown["rgb"], (0.5 + shown["detail"]).clamp(0, 1))
    assert bool((shown["field_rgb"] == 0.5).all())
    double = Details(tmp_path).added(outputs, bundle, 4, torch.full((3,), 2.0))
    assert torch.allclose(double["rgb"], (0.5 + 2 * shown["detail"]).clamp(0, 1))


def test_other_surfaces_masks_and_empty_pixels_show_nothing(tmp_path):
    planes = [torch.cat([torch.full((3, HEIGHT, WIDTH), 0.2), torch.full((1, HEIGHT, WIDTH), 0.25)])]
    bundle, open_ = image_rays(camera(0.4)), torch.ones(HEIGHT, WIDTH, 1)
    outputs = {"depth": torch.full((HEIGHT, WIDTH, 1), 4.0), "accumulation": open_, "rgb": open_.expand(-1, -1, 3) / 2}
    write(tmp_path, joined(camera()), planes)
    assert Details(tmp_path).added(outputs, bundle, 4, None)["detail"][:, :-8].min() > 0.1
    behind = outputs | {"depth": torch.full((HEIGHT, WIDTH, 1), 1.0)}
    assert Details(tmp_path).added(behind, bundle, 4, None)["detail"].abs().max() < 1e-3
    empty = outputs | {"accumulation": torch.zeros_like(open_)}
    assert not Details(tmp_path).added(empty, bundle, 4, None)["detail"].any()
    write(tmp_path, joined(camera()), planes, mask=np.zeros((HEIGHT, WIDTH), np.uint8))
    for place in (bundle, image_rays(camera())):
        assert not Details(tmp_path).added(outputs, place, 4, None)["detail"].any()


def test_details_change_smoothly_as_a_camera_moves(tmp_path):
    """Also where the set of nearest training images changes: here halfway between cameras."""
    planes = [
        torch.cat([torch.full((3, HEIGHT, WIDTH), 0.4 * sign), torch.full((1, HEIGHT, WIDTH), 0.25)])
        for sign in (1, -1, -1, 1, 1, -1)
    ]
    write(tmp_path, joined(*(camera(0.2 * i) for i in range(6))), planes)
    details, shown = Details(tmp_path), []
    for x in np.linspace(0.2, 0.8, 241):
        bundle = image_rays(camera(float(x)))
        shown.append(details.of_image(bundle, torch.full((HEIGHT, WIDTH, 1), 4.0), 2)[8:12, 12:16].mean())
    steps = torch.stack(shown).diff().abs()
    assert torch.stack(shown).std() > 0.05
    assert steps.max() < 0.03


def test_moved_cameras_are_where_their_rays_are():
    cameras = joined(camera(), camera(0.3, turn=0.2))
    poses = CameraOptimizerConfig(mode="SO3xR3").setup(num_cameras=2, device="cpu")
    with torch.no_grad():
        poses.pose_adjustment.copy_(torch.randn(2, 6) * 0.05)
    bundle = image_rays(cameras[1:2]).flatten()
    bundle.camera_indices = torch.ones_like(bundle.camera_indices)
    poses.apply_to_raybundle(bundle)
    moved = image_rays(moved_cameras(cameras, poses)[1:2]).flatten()
    assert torch.allclose(moved.origins, bundle.origins, atol=1e-5)
    assert torch.allclose(moved.directions, bundle.directions, atol=1e-4)


def test_details_of_another_checkpoint_are_not_shown(tmp_path, capsys):
    write(tmp_path, joined(camera()), [random_planes(0, 4.0)], step=7)
    details = details_of(tmp_path, 7)
    assert details is not None and details.step == 7
    assert details_of(tmp_path, 8) is None
    assert details_of(tmp_path / "none", 7) is None
    assert "images show the field alone" in " ".join(capsys.readouterr().out.split())


def test_damaged_details_are_named(tmp_path):
    write(tmp_path, joined(camera()), [random_planes(0, 4.0)])
    (tmp_path / "00000.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"00000\.npz is damaged.*remove the folder"):
        Details(tmp_path).view(0, torch.device("cpu"))
    (tmp_path / "cameras.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"cameras\.npz is damaged"):
        details_of(tmp_path, 7)


def test_cameras_of_other_types_have_no_details(tmp_path):
    cameras = camera(kind=CameraType.EQUIRECTANGULAR)
    assert "neither perspective nor fisheye" in write(tmp_path / "details", cameras, [])
    assert not (tmp_path / "details").exists()
