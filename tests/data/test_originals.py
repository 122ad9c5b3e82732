"""Which file an image was made from, and its camera there."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from mmpi_ns.data.copies import fit_cameras, original_of
from mmpi_ns.data.posed_images import PosedImages, at_full_size
from mmpi_prepare.export import downscale


def write(path: Path, width: int, height: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (width, height)).save(path)
    return path


def posed(file: Path, width: int, height: int) -> PosedImages:
    pose = np.eye(4)[None, :3]
    intrinsics = np.array([[180.5, 181.5, 152.25, 43.5]])
    return PosedImages((file,), pose, intrinsics, np.array([[float(width), height]]), np.zeros((1, 4)))


def test_a_copy_stands_for_its_whole_original(tmp_path):
    original = write(tmp_path / "images/a/x.png", 1242, 375)
    copy = write(tmp_path / "images_4/a/x.png", 310, 93)  # rounded down: the scale of its pixels is not 4
    assert original_of(copy) == (original, 4)
    views = at_full_size(posed(copy, 310, 93))
    assert views.files == (original,) and views.sizes.tolist() == [[1242, 375]]
    x, y = 1242 / 310, 375 / 93
    assert views.intrinsics[0] == pytest.approx([180.5 * x, 181.5 * y, 152.25 * x, 43.5 * y])


def picture(width: int, height: int) -> Image.Image:
    rng = np.random.default_rng(0)
    return Image.fromarray(rng.integers(0, 256, (height // 6 + 1, width // 6 + 1)).astype(np.uint8)).resize(
        (width, height), Image.Resampling.BICUBIC
    )


@pytest.mark.parametrize("by", [downscale, None], ids=["cut by mmpi-prepare", "whole"])
def test_copies_that_are_cut_are_told_from_those_of_the_whole_image(tmp_path, by):
    original, copy = tmp_path / "images/x.jpg", tmp_path / "images_4/x.jpg"
    original.parent.mkdir()
    picture(1243, 375).save(original)
    if by is None:
        copy.parent.mkdir()
        picture(1243, 375).resize((310, 93), Image.Resampling.LANCZOS).save(copy)
    else:
        by(original, copy, 4)
    views = at_full_size(posed(copy, 310, 93))
    x, y = (4, 4) if by else (1243 / 310, 375 / 93)
    assert views.intrinsics[0] == pytest.approx([180.5 * x, 181.5 * y, 152.25 * x, 43.5 * y])


def test_an_image_that_is_reduced_when_it_is_read_keeps_its_angles(tmp_path):
    file = write(tmp_path / "x.png", 1240, 372)
    views = at_full_size(posed(file, 310, 93))
    assert views.sizes.tolist() == [[1240, 372]] and views.intrinsics[0] == pytest.approx([722, 726, 609, 174])


def transforms(folder: Path) -> Callable[[int], DataParserConfig]:
    """Parsers of a scene of three originals in nerfstudio's format, by downscale factor."""
    camera = {"fl_x": 721.5, "fl_y": 720.5, "cx": 609.6, "cy": 172.9, "w": 1242, "h": 375}
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = range(3)
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return lambda factor: NerfstudioDataParserConfig(data=folder, downscale_factor=factor)


def colmap(folder: Path) -> Callable[[int], DataParserConfig]:
    """The same of a COLMAP model."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=1242, height=375, params=[721.5, 720.5, 609.6, 172.9], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for i in range(3):
        image = pycolmap.Image(name=f"{i}.png", camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), [float(i), 0, 0]))
        model.register_frame(model.image(i + 1).frame_id)
    (folder / "sparse/0").mkdir(parents=True)
    model.write(folder / "sparse/0")
    return lambda factor: ColmapDataParserConfig(
        data=folder, colmap_path=Path("sparse/0"), downscale_factor=factor, load_3D_points=False
    )


@pytest.mark.parametrize("scene", [transforms, colmap])
@pytest.mark.parametrize("size", [(310, 93), (311, 94)], ids=["rounded down", "rounded up"])
def test_cameras_of_copies_look_where_those_of_the_originals_do(tmp_path, size, scene):
    """nerfstudio divides intrinsics by 4: the lower right corner would look 0.3 and 0.7 pixels past its image."""
    for name in ("0.png", "1.png", "2.png"):
        write(tmp_path / "images" / name, 1242, 375)
        write(tmp_path / "images_4" / name, *size)
    parser = scene(tmp_path)

    def cameras(factor: int) -> Cameras:
        return fit_cameras(parser(factor).setup().get_dataparser_outputs("train"), factor).cameras

    whole, copies = cameras(1), cameras(4)
    assert copies.width[0] == 310 and copies.height[0] == 93
    for at in ((0.0, 0.0), (0.3, 0.9), (1.0, 1.0)):  # of width and height
        tangents = [
            ((at[0] * w - float(c.cx[i])) / float(c.fx[i]), (at[1] * h - float(c.cy[i])) / float(c.fy[i]))
            for c, (w, h) in ((whole, (1242, 375)), (copies, size))
            for i in range(len(c))
        ]
        assert np.ptp(np.array(tangents), axis=0) == pytest.approx([0, 0], abs=1e-6)
