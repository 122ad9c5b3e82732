"""What of a data set becomes observations: cameras with their lenses, tracks, and which points are good enough."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from PIL import Image
from tiny_scene import write_colmap

from mmpi_ns.data.posed_images import PosedImages, camera_observations, posed_images
from mmpi_ns.placement.observations import Observations
from mmpi_priors.observe import (
    drop_masked,
    warn_of_poses,
    with_surfaces,
    with_tracks,
)
from mmpi_priors.sfm import SfmModel, find_sfm_model, numbers_in_model
from mmpi_priors.views import project, straightened

SIZES = np.array([[40.0, 20.0], [80.0, 60.0]])


def bare() -> Observations:
    """Two cameras of different sizes."""
    none = np.zeros(0, np.int64)
    return Observations(
        camera_to_worlds=np.tile(np.eye(4)[:3], (2, 1, 1)),
        intrinsics=np.array([[30.0, 31, 20, 10], [60, 61, 40, 30]]),
        sizes=SIZES,
        points=np.zeros((0, 3)),
        seen_by=none,
        seen_point=none,
        seen_at=np.zeros((0, 2)),
    )


class Data(SimpleNamespace):
    """As much of a data set of two images as is asked for."""

    def __len__(self):
        return 2


def as_data(kind=CameraType.PERSPECTIVE, lens=None, **more):
    poses = torch.eye(4)[None, :3].repeat(2, 1, 1)
    cameras = Cameras(poses, 30.0, 30.0, 20.0, 10.0, 40, 20, distortion_params=lens, camera_type=kind)
    return Data(cameras=cameras, image_filenames=["a/x.png", "b/x.png"], **more)


LENS = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [1.1, 1.2, 1.3, 1.4, 1.5, 1.6]])  # nerfstudio's k1 k2 k3 k4 p1 p2
PERSPECTIVE = LENS * torch.tensor([1, 1, 1, 0, 1, 1])  # OpenCV has no k4


def test_images_of_a_rig_are_told_apart_by_their_folders():
    rig = ["left/1.png", "right/1.png", "left/2.png"]
    files = [Path("/data/images_2") / name for name in ("right/1.png", "left/2.png", "left/1.png")]
    assert numbers_in_model(files, rig).tolist() == [1, 2, 0]
    assert numbers_in_model([Path("images/2.png"), Path("images/1.png")], rig).tolist() == [2, -1]  # moved: one 2.png
    assert numbers_in_model(files, ["1.png", "2.png"]).tolist() == [-1, 1, -1]  # two would be 1.png
    assert numbers_in_model([files[0]] * 2, rig).tolist() == [1, 1]  # a frame that is listed twice


def test_each_camera_of_a_mixture_has_its_own_lens_and_others_are_none():
    kinds = torch.tensor([[CameraType.PERSPECTIVE.value], [CameraType.FISHEYE.value]])
    lens = torch.stack([PERSPECTIVE[0], LENS[1]])
    images = posed_images(bare(), as_data(kind=kinds, lens=lens))
    assert images is not None and [images.is_fisheye(i) for i in range(2)] == [False, True]
    assert [images.lens(i).round(6).tolist() for i in range(2)] == [[0.1, 0.2, 0.5, 0.6, 0.3], [1.1, 1.2, 1.3, 1.4]]
    assert posed_images(bare(), as_data(kind=kinds, lens=LENS)) is None
    kinds[1] = CameraType.EQUIRECTANGULAR.value
    assert posed_images(bare(), as_data(kind=kinds, lens=lens)) is None


def test_k3_of_a_perspective_lens_bends_views_as_it_bends_rays():
    """The oracle is nerfstudio's ray generator."""
    data = as_data(lens=torch.tensor([[0.05, -0.02, 0.3, 0.0, 0.01, -0.01]]).repeat(2, 1))
    images = posed_images(camera_observations(data.cameras, []), data)
    assert images is not None
    local = data.cameras.generate_rays(0).directions.double().numpy()
    wanted = np.stack([local[..., 0], -local[..., 1]]) / -local[..., 2]
    np.testing.assert_allclose(straightened(images, 0, (20, 40)), wanted, atol=2e-4)
    rows, columns = np.mgrid[0:20, 0:40] + 0.5
    np.testing.assert_allclose(
        project(images, 0, 5 * local.reshape(-1, 3)), np.stack([columns, rows], -1).reshape(-1, 2), atol=0.01
    )


@pytest.mark.parametrize(
    ("kind", "used"), [(CameraType.PERSPECTIVE, (0.1, 0.2, 0.5, 0.6, 0.3)), (CameraType.FISHEYE, (0.1, 0.2, 0.3, 0.4))]
)
def test_a_lens_goes_to_colmap_in_its_order(kind, used):
    images = posed_images(bare(), as_data(kind=kind, lens=PERSPECTIVE if kind is CameraType.PERSPECTIVE else LENS))
    assert images is not None and images.is_fisheye(1) == (kind is CameraType.FISHEYE)
    assert np.array([images.lens(i) for i in range(2)]) == pytest.approx(np.array([used, np.add(used, 1)]))
    assert [str(f) for f in images.files] == ["a/x.png", "b/x.png"] and np.array_equal(images.sizes, SIZES)
    assert not posed_images(bare(), as_data(kind=kind)).distortion.any()


def model(*keypoints) -> SfmModel:
    """Tracks (camera, point, share of the width, share of the height) of four points."""
    rows = np.array([(row, *k[1:]) for row, name in enumerate((1, 0)) for k in keypoints if k[0] == name])
    seen_by, seen_point = rows[:, :2].astype(np.int64).T
    return SfmModel(np.arange(12.0).reshape(4, 3), np.array(["1", "0"]), seen_by, seen_point, rows[:, 2:])


def test_tracks_come_in_pixels_of_the_camera_whose_place_names_them():
    actual = with_tracks(bare(), model((0, 2, 0.25, 0.5), (1, 3, 0.75, 0.1), (1, 2, 0.5, 0.5)))
    assert actual.seen_by.tolist() == [0, 1, 1] and actual.seen_point.tolist() == [2, 3, 2]
    assert actual.seen_at == pytest.approx(np.array([[10, 10], [60, 6], [40, 30]]))
    assert np.array_equal(actual.points, np.arange(12.0).reshape(4, 3))


@pytest.mark.parametrize("depth", [12.0, 120.0])
def test_searched_surfaces_lie_on_a_textured_wall(tmp_path, depth):
    """Also on one so far away that it moves by three pixels from the first image to the last."""
    count, (width, height), focal = 5, (248, 76), 144.0
    poses = np.tile(np.eye(4)[:3], (count, 1, 1))
    poses[:, 0, 3] = centers = np.linspace(-1, 1, count)
    rng, (ys, xs), files = np.random.default_rng(3), np.mgrid[0:height, 0:width] + 0.5, []
    waves, phases = rng.normal(size=(40, 2)) * 20 / depth, rng.uniform(0, 6, 40)
    for i, center in enumerate(centers):
        wall = np.stack([(xs - width / 2) / focal, (ys - height / 2) / focal], -1) * depth + [center, 0]
        levels = 127 + 9 * np.sin(wall @ waves.T + phases).sum(-1)
        files.append(tmp_path / f"{i}.png")
        Image.fromarray(levels.clip(0, 255).round().astype(np.uint8)).save(files[-1])
    pinholes, sizes = (np.tile(row, (count, 1)) for row in ([focal, focal, width / 2, height / 2], [width, height]))
    cameras = Observations(poses, pinholes, sizes.astype(float), points=np.ones((3, 3)))
    actual = with_surfaces(cameras, PosedImages(tuple(files), poses, pinholes, sizes, np.zeros((count, 4))))
    assert np.array_equal(actual.points[:3], np.ones((3, 3))) and len(actual.points) > 500 and not len(actual.seen_at)
    assert np.percentile(np.abs(actual.points[3:, 2] + depth), 80) < 0.1 * depth
    # Every view counts for a point that falls on its image, and no other does.
    local = actual.points[3:] - poses[:, None, :, 3]
    visible = np.abs(focal * local[..., :2] / local[..., 2:]) < [width / 2, height / 2]
    expected = {(int(i), int(p) + 3) for i, p in np.argwhere(visible.all(-1))}
    assert set(zip(actual.seen_by.tolist(), actual.seen_point.tolist(), strict=True)) == expected
    assert len(actual.seen_by) == len(expected) > 2 * len(actual.points)


def test_poses_that_are_off_are_told_with_the_command_that_mends_them(capsys):
    warn_of_poses(0.49, Path("room/images_2/a.png"))
    assert not capsys.readouterr().out
    warn_of_poses(1.34, Path("room/images_2/a.png"))
    assert "--poses room/transforms.json --refine-poses" in capsys.readouterr().out.replace("\n", " ")


def test_a_mask_leaves_out_the_keypoints_on_its_black_pixels():
    """Rows and columns differ, so that neither can stand for the other; what a search found has no keypoint."""
    tracks = with_tracks(bare(), model((0, 0, 0.7, 0.1), (0, 1, 0.1, 0.7), (1, 2, 0.7, 0.1), (1, 3, 0.999, 0.999)))
    masks = [np.ones((20, 40), bool), np.ones((60, 80), bool)]
    masks[0][10:, :20] = False
    data = as_data(usable=lambda i: masks[i], has_masks=True, has_alpha=False)
    actual = drop_masked(tracks, data)
    assert actual.seen_point.tolist() == [0, 2, 3] and len(actual.seen_at) == 3


def test_points_that_project_badly_or_that_few_images_see_are_left_out(tmp_path):
    write_colmap(tmp_path / "model")
    path = tmp_path / "model/points3D.txt"
    rows = [line.split() for line in path.read_text().splitlines()]
    whole = find_sfm_model(tmp_path / "model")
    long = [r for r in rows if len(r[8:]) / 2 >= 3]
    assert whole is not None and len(whole.points) == len(long) < len(rows)
    long[3][7], long[5][7] = "2.01", "1.99"
    path.write_text("\n".join(" ".join(r) for r in rows) + "\n")
    actual = find_sfm_model(tmp_path / "model")
    assert actual is not None and np.array_equal(actual.points, np.delete(whole.points, 3, 0))
    assert len(actual.seen_by) == len(whole.seen_by) - len(long[3][8:]) / 2
