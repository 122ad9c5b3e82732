"""Rays from between training cameras, on the tiny scene, whose true colour along any ray is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hand_made import posed
from nerfstudio.cameras.cameras import Cameras, CameraType
from tiny_scene import FOCAL, HEIGHT, TRAIN, WALL, WIDTH, color_of, image_of, on_wall, pixel_rays, pose_of

from mmpi_ns.data.priors import DepthPriors, packed
from mmpi_priors import new_views
from mmpi_priors.new_views import find_shared_points
from mmpi_priors.views import project

POSES = np.stack([pose_of(i)[:3] for i in TRAIN])


def rays_of(indices):
    """Rays through pixel centres, in float64."""
    camera, row, column = indices.T.numpy()
    directions = pixel_rays().reshape(HEIGHT, WIDTH, 3)[row, column]
    directions = np.einsum("nij,nj->ni", POSES[camera][:, :, :3], directions)
    origins = torch.from_numpy(POSES[camera][:, :, 3]).float()
    return SimpleNamespace(
        origins=origins, directions=torch.from_numpy(directions).float(), camera_indices=indices[:, :1]
    )


def true_distance(origins, directions):
    """Distance of the wall along unit rays, infinite where they pass it."""
    t = (WALL - origins[:, 2]) / directions[:, 2]
    x, y = (origins + t[:, None] * directions)[:, :2].T
    return np.where(on_wall(x, y) & (t > 0), t, np.inf)


def exact_depths(error=0.01):
    """Exact inverse distances of the wall, unknown elsewhere."""
    maps = []
    for pose in POSES:
        directions = pixel_rays() @ pose[:, :3].T
        inverse = 1 / true_distance(np.broadcast_to(pose[:, 3], directions.shape), directions)
        maps.append(np.stack([inverse, error * inverse], -1).reshape(HEIGHT, WIDTH, 2).astype(np.float32))
    return DepthPriors([packed(m) for m in maps])


class Images:
    """Stands for the data set."""

    has_alpha = False

    def __init__(self, mask=None, alpha=None):
        self.mask, self.alpha = mask, alpha
        self.has_alpha = alpha is not None

    def get_data(self, i, image_type):
        assert image_type == "uint8"
        image = torch.from_numpy((image_of(TRAIN[i]) * 255).round().astype(np.uint8))
        if self.alpha is not None and i in self.alpha:
            image = torch.cat([image, torch.from_numpy(self.alpha[i])[..., None]], -1)
        return {"image": image} | ({} if self.mask is None else {"mask": torch.from_numpy(self.mask)[..., None]})


CAMERA = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], [WIDTH, HEIGHT]


def find(known=None, dataset=None):
    return find_shared_points(dataset or Images(), posed(POSES, *CAMERA), known or exact_depths(), rays_of, range(6), 0)


def drawn(points):
    bundle, colors, depths = points.draw(2000, rays_of, [torch.Generator().manual_seed(0)])
    return bundle.origins.double().numpy(), bundle.directions.double().numpy(), colors.numpy(), depths.double().numpy()


def test_a_ray_ends_on_its_point_and_shows_its_colour():
    origins, directions, colors, depths = drawn(find())
    distance = true_distance(origins, directions)
    assert np.abs(np.linalg.norm(directions, axis=-1) - 1).max() < 1e-6
    assert np.isfinite(distance).all(), "an end lies beside the wall"
    assert np.abs(depths[:, 0] * distance - 1).max() < 3.6e-4  # as depths are stored
    error = np.abs(colors - color_of(origins, directions)).max(-1)
    # Where the second image is read within a pixel of the wall's edge, its colour is mixed with what lies beyond.
    assert np.quantile(error, 0.95) < 0.03 and np.median(error) < 0.006


def test_errors_follow_the_distance():
    *_, depths = drawn(find(exact_depths(0.02)))
    points = find(exact_depths(0.02))
    chosen = torch.randint(len(points.pixels), (2000,), generator=torch.Generator().manual_seed(0))
    first = points.depths[chosen].double().numpy()
    # dq = dt / t^2: the same length along the ray at another distance.
    assert np.allclose(depths[:, 1], first[:, 1] * (depths[:, 0] / first[:, 0]) ** 2, rtol=1e-4)


def test_origins_lie_between_the_two_cameras_and_anywhere_there():
    points = find()
    origins, *_ = drawn(points)
    chosen = torch.randint(len(points.pixels), (2000,), generator=torch.Generator().manual_seed(0))
    start, end = (POSES[n[chosen].long().numpy()][:, :, 3] for n in (points.pixels[:, 0], points.other))
    way = end - start
    share = ((origins - start) * way).sum(-1) / (way * way).sum(-1)
    assert np.abs(origins - start - share[:, None] * way).max() < 1e-6
    assert share.min() > -1e-6 and share.max() < 1 + 1e-6
    assert np.abs(np.histogram(share, 4, (0, 1))[0] - 500).max() < 100


def test_points_come_from_the_nearest_images():
    points = find()
    for i, j in {(int(i), int(j)) for i, j in zip(points.pixels[:, 0], points.other, strict=True)}:
        distance = np.linalg.norm(POSES[:, :, 3] - POSES[i, :, 3], axis=-1)
        assert i != j and distance[j] <= np.sort(distance)[new_views.NEIGHBOURS]


def test_a_depth_that_the_other_image_contradicts_is_no_point():
    known = exact_depths()
    wrong = DepthPriors([packed(known.image(0) * np.float32([1.1, 1])), *known.codes[1:]])
    points = find(wrong)
    assert not (points.pixels[:, 0] == 0).any() and not (points.other == 0).any() and len(points.other) > 100


def test_masks_and_transparent_pixels_are_left_out():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 0
    points = find(dataset=Images(mask=mask))
    assert (points.pixels[:, 2] >= WIDTH // 2).all()
    opacity = np.full((HEIGHT, WIDTH), 255, np.uint8)
    opacity[HEIGHT // 2 :] = 128
    points = find(dataset=Images(alpha={0: opacity}))
    assert points.colors.shape[-1] == 4 and (points.colors[..., 3] == 255).all()
    assert (points.pixels[points.pixels[:, 0] == 0][:, 1] < HEIGHT // 2).all()


@pytest.mark.parametrize(
    ("lens", "kind"), [((0.05, -0.02, 0.003, -0.002), "PERSPECTIVE"), ((0.03, -0.01, 0.0, 0.0), "FISHEYE")]
)
def test_projection_is_the_inverse_of_nerfstudios_rays(lens, kind):
    k = (*lens[:2], 0.0, 0.0, *lens[2:]) if kind == "PERSPECTIVE" else (*lens, 0.0, 0.0)
    cameras = Cameras(
        torch.from_numpy(POSES).float(), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT,
        torch.tensor(k)[None].expand(len(POSES), -1), CameraType[kind],
    )  # fmt: skip
    indices = torch.tensor([[j, r, c] for j in range(3) for r in range(0, HEIGHT, 5) for c in range(0, WIDTH, 7)])
    rays = cameras.generate_rays(indices[:, :1], coords=indices[:, 1:] + 0.5)
    images = posed(POSES, *CAMERA, lens=lens, fisheye=kind == "FISHEYE")
    for j in range(3):
        own = indices[:, 0] == j
        ends = (rays.origins + 3.7 * rays.directions)[own].double().numpy()
        at = project(images, j, ends)
        assert np.abs(at - (indices[own][:, 1:].flip(-1) + 0.5).numpy()).max() < 2e-3
    behind = (rays.origins - 3.7 * rays.directions)[:4].double().numpy()
    assert (project(images, 0, behind) == -1e4).all()


def test_a_point_of_another_colour_in_the_other_image_is_no_point():
    class Changed(Images):
        def get_data(self, i, image_type):
            data = super().get_data(i, image_type)
            return data if i else data | {"image": data["image"] // 3}

    points = find(dataset=Changed())
    with_first = (points.pixels[:, 0] == 0) | (points.other == 0)
    assert with_first.sum() < 0.04 * len(with_first) and len(with_first) > 1000
