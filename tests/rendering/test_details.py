"""Details of training images: what is kept of them, blended, and what must not show: other surfaces, masked pixels, and
details of another checkpoint."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle

from mmpi_ns.data.rays import image_rays
from mmpi_ns.model import MMPIModel
from mmpi_ns.rendering.details import (
    HERE,
    LARGEST,
    LEAST_WEIGHT,
    LEVELS,
    MIDDLE,
    STRENGTH,
    TURN,
    Details,
    DetailView,
    details_of,
    moved_cameras,
    write_details,
)
from mmpi_ns.settings import MMPIModelConfig
from mmpi_ns.utils.errors import InputError

HEIGHT, WIDTH = 20, 28
AT_CAMERA = STRENGTH / (1 + LEAST_WEIGHT * TURN)
"""Factor on the residual of a single training image at its camera."""


def camera(x=0.0, turn=0.0, kind=CameraType.PERSPECTIVE) -> Cameras:
    """At a place, turned about the vertical axis by an angle."""
    c, s = math.cos(turn), math.sin(turn)
    pose = torch.tensor([[[c, 0, s, x], [0, 1, 0, 0], [-s, 0, c, 0]]])
    return Cameras(pose, 22.0, 21.0, 14.5, 9.0, WIDTH, HEIGHT, camera_type=kind)


def random_planes(seed: int, depth: float) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    difference = torch.randn(3, HEIGHT, WIDTH, generator=g) * 0.1
    return torch.cat([difference, torch.rand(1, HEIGHT, WIDTH, generator=g) * 0.1 + 1 / depth])


def test_details_are_the_weighted_mean_of_the_views():
    """Of two cameras to the left and to the right: by shares and viewing angles, worked out by hand. A third one, where
    shares reach 0, is not read."""
    views, cameras = [], []
    for x, value in ((-0.5, 0.2), (1.0, -0.1)):
        numbers = torch.tensor([1.0, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 22, 21, 14.5, 9, *[0.0] * 7, 10])
        inverse = 1 / math.hypot(x, 5)
        views.append(DetailView(torch.tensor([value] * 3 + [inverse]).expand(HEIGHT, WIDTH, 4).contiguous(), numbers))
        cameras.append(numbers)
    cameras.append(cameras[-1].index_fill(0, torch.tensor([3]), 2.0))
    ray = RayBundle(torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0, -1]]]), torch.ones(1, 1, 1))
    shares = [(1 - (distance / 2) ** 2) ** 2 for distance in (0.5, 1.0)]
    angles = [2 * math.sin(math.atan(x / 5) / 2) for x in (0.5, 1.0)]
    farther = [math.hypot(x / 5, 1) for x in (0.5, 1.0)]
    weights = [s / ((a + 0.01) * far**4) for a, s, far in zip(angles, shares, farther, strict=True)]
    faded = [
        (value - HERE * (0.3 - MIDDLE)) / (1 + (angle / 0.3) ** 2)
        for angle, value in zip(angles, (0.2, -0.1), strict=True)
    ]
    expected = STRENGTH * (faded[0] * weights[0] + faded[1] * weights[1]) / (sum(weights) + LEAST_WEIGHT)
    outputs = {
        "depth": torch.full((1, 1, 1), 5.0),
        "accumulation": torch.ones(1, 1, 1),
        "rgb": torch.full((1, 1, 3), 0.3),
    }
    result = Details(torch.stack(cameras), lambda i, _: views[i]).added(
        outputs | {"radiance": outputs["rgb"]}, ray, 2, None
    )
    assert torch.allclose(result["radiance"], torch.full((1, 1, 3), 0.3 + expected), rtol=1e-3)


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
    details = read_details(tmp_path)
    for i, expected in enumerate(planes):
        field = 128 / 255 / torch.tensor([0.8, 1.0, 1.2])[:, None, None] - expected[:3]
        view = details.view(i, torch.device("cpu"))
        assert torch.allclose(view.camera[:12].view(3, 4), cameras.camera_to_worlds[i])
        assert view.camera[12:16].tolist() == [22.0, 21.0, 14.5, 9.0]
        difference, inverse = view.image[..., :3].movedim(-1, 0), view.image[..., 3]
        assert (difference - expected[:3] - HERE * (field - MIDDLE)).abs().max() <= 0.5 * LARGEST / LEVELS + 1e-4
        assert torch.allclose(inverse, expected[3], rtol=1e-3)


def read_details(folder):
    """Those of ``write``."""
    details = details_of(folder, 7)
    assert details is not None
    return details


def test_an_image_at_a_training_camera_gets_its_details(tmp_path):
    planes = [random_planes(0, 4.0)]
    write(tmp_path, joined(camera()), planes)
    bundle, field = image_rays(camera()), 128 / 255 - planes[0][:3].movedim(0, -1)
    outputs = {"depth": 1 / planes[0][3][..., None], "accumulation": torch.ones(HEIGHT, WIDTH, 1),
               "rgb": field}  # fmt: skip
    result = read_details(tmp_path).added(outputs, bundle, 4, None)
    expected = AT_CAMERA * planes[0][:3].movedim(0, -1)
    assert torch.allclose(result["rgb"], (field + expected).clamp(0, 1), atol=4e-3)
    assert torch.equal(result["field_rgb"], field)
    double = read_details(tmp_path).added(outputs, bundle, 4, torch.full((3,), 2.0))
    assert torch.allclose(double["rgb"], (field + 2 * expected).clamp(0, 1), atol=8e-3)
    light = read_details(tmp_path).added(outputs | {"radiance": outputs["rgb"]}, bundle, 4, None)
    assert torch.allclose(light["radiance"], field + expected, atol=4e-3) and torch.equal(
        light["field_radiance"], field
    )


def test_surfaces_too_near_for_half_precision_give_finite_colours(tmp_path):
    write(tmp_path, joined(camera()), [random_planes(0, 1e-6)])
    field = {name: torch.full((HEIGHT, WIDTH, 3), 0.5) for name in ("rgb", "radiance")}
    near = {"depth": torch.full((HEIGHT, WIDTH, 1), 1e-6), "accumulation": torch.ones(HEIGHT, WIDTH, 1)}
    assert read_details(tmp_path).added(field | near, image_rays(camera()), 1, None)["rgb"].isfinite().all()


def test_what_was_learned_of_one_image_alone_is_not_lost_in_others(tmp_path):
    """A field that fits its training image leaves no difference there; where it lacks in another, a part comes back."""
    planes = [torch.cat([torch.zeros(3, HEIGHT, WIDTH), torch.full((1, HEIGHT, WIDTH), 0.25)])]
    write(tmp_path, joined(camera()), planes)
    whole = torch.ones(HEIGHT, WIDTH, 1)
    outputs = {"depth": 4 * whole, "accumulation": whole, "rgb": 0.3 * whole.expand(-1, -1, 3)}
    added = read_details(tmp_path).added(outputs, image_rays(camera()), 4, None)["rgb"] - 0.3
    assert torch.allclose(added, torch.tensor(AT_CAMERA * HERE * (128 / 255 - 0.3)), atol=4e-3)


def test_other_surfaces_masks_and_empty_pixels_show_nothing(tmp_path):
    def added(outputs, rays):
        return read_details(tmp_path).added(outputs, rays, 4, None)["rgb"]

    planes = [torch.cat([torch.full((3, HEIGHT, WIDTH), 0.2), torch.full((1, HEIGHT, WIDTH), 0.25)])]
    bundle, open_ = image_rays(camera(0.4)), torch.ones(HEIGHT, WIDTH, 1)
    outputs = {"depth": torch.full((HEIGHT, WIDTH, 1), 4.0), "accumulation": open_, "rgb": open_.expand(-1, -1, 3) / 2}
    write(tmp_path, joined(camera()), planes)
    assert (added(outputs, bundle) - 0.5)[:, :-8].min() > 0.1
    behind = outputs | {"depth": torch.full((HEIGHT, WIDTH, 1), 1.0)}
    assert (added(behind, bundle) - 0.5).abs().max() < 1e-3
    empty = outputs | {"accumulation": torch.zeros_like(open_)}
    assert bool((added(empty, bundle) == 0.5).all())
    write(tmp_path, joined(camera()), planes, mask=np.zeros((HEIGHT, WIDTH), np.uint8))
    for place in (bundle, image_rays(camera())):
        assert bool((added(outputs, place) == 0.5).all())


def test_details_change_smoothly_as_a_camera_moves(tmp_path):
    """Also where the set of nearest training images changes: here halfway between cameras."""
    planes = [
        torch.cat([torch.full((3, HEIGHT, WIDTH), 0.4 * sign), torch.full((1, HEIGHT, WIDTH), 0.25)])
        for sign in (1, -1, -1, 1, 1, -1)
    ]
    write(tmp_path, joined(*(camera(0.2 * i) for i in range(6))), planes)
    details, result = read_details(tmp_path), []
    for x in np.linspace(0.2, 0.8, 241):
        bundle = image_rays(camera(float(x)))
        grey, whole = torch.full((HEIGHT, WIDTH, 3), MIDDLE), torch.ones(HEIGHT, WIDTH, 1)
        outputs = {"rgb": grey, "radiance": grey, "depth": 4 * whole, "accumulation": whole}
        result.append(details.added(outputs, bundle, 2, None)["radiance"][8:12, 12:16].mean())
    steps = torch.stack(result).diff().abs()
    assert torch.stack(result).std() > 0.05
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
    folder = tmp_path / "details"
    write(folder, joined(camera()), [random_planes(0, 4.0)], step=7)
    assert details_of(folder, 7) is not None
    assert details_of(folder, 8) is None
    assert details_of(tmp_path / "none", 7) is None
    config = MMPIModelConfig()
    config.windows_folder = tmp_path / "windows"
    model = SimpleNamespace(config=config, trains=False, details=None, capture=None)
    capsys.readouterr()
    MMPIModel.update_to_step(model, 7)
    assert model.details is not None and not capsys.readouterr().out
    MMPIModel.update_to_step(model, 8)
    assert model.details is None
    assert "images show the field alone" in " ".join(capsys.readouterr().out.split())


def test_damaged_details_are_named(tmp_path):
    write(tmp_path, joined(camera()), [random_planes(0, 4.0)])
    (tmp_path / "00000.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"00000\.npz is damaged.*remove the folder"):
        read_details(tmp_path).view(0, torch.device("cpu"))
    (tmp_path / "cameras.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"cameras\.npz is damaged"):
        details_of(tmp_path, 7)


def test_cameras_of_other_types_have_no_details(tmp_path):
    cameras = camera(kind=CameraType.EQUIRECTANGULAR)
    assert "neither perspective nor fisheye" in write(tmp_path / "details", cameras, [])
    assert not (tmp_path / "details").exists()
