"""Depth images of an RGB-D camera, from folder to scene, in a corridor whose depths are known."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import corridor
import numpy as np
import pytest
from PIL import Image

from mmpi_ns.data.dataset import read_depth_image
from mmpi_ns.utils.errors import InputError
from mmpi_prepare.depths import find_depths, read_millimetres
from mmpi_prepare.depths import write_depths as write_depths_of_scene
from mmpi_prepare.images import Photo
from mmpi_prepare.pipeline import Preparation, prepare
from mmpi_prepare.settings import Settings

COUNT, POSES = 8, corridor.poses(8)


def write_depths(folder, poses):
    """Depth images with 1 % of noise and a hole, for frame_001.png and so on."""
    folder.mkdir()
    random = np.random.default_rng(0)
    for i, pose in enumerate(poses, 1):
        metres = corridor.depth(pose) * random.normal(1, 0.01, (corridor.HEIGHT, corridor.WIDTH))
        metres[:40, :40] = 0
        Image.fromarray((1000 * metres).round().astype(np.uint16)).save(folder / f"frame_{i:03d}.png")
    return folder


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rgbd") / "frames"
    corridor.write_images(folder, COUNT)
    return folder


@pytest.mark.parametrize("known", [False, True])
def test_depths_of_the_scene_are_those_of_its_poses(known, frames, tmp_path, capsys):
    """Without poses the scene is in metres; with poses in units of half a metre the depths follow these."""
    units, poses = 2.0 if known else 1.0, None
    if known:
        scaled = POSES[:, :3] * [1, 1, 1, units]
        poses = tmp_path / "poses.txt"
        np.savetxt(poses, scaled.reshape(COUNT, 12))
    given, scene = write_depths(tmp_path / "depths", POSES), tmp_path / "scene"
    prepare(Settings(frames, scene, depths=given, moving="keep", threads=1, focal=corridor.FOCAL, poses=poses))
    meta = json.loads((scene / "transforms.json").read_text())
    matrices = np.array([f["transform_matrix"] for f in sorted(meta["frames"], key=lambda f: f["file_path"])])
    track, true = (np.linalg.norm(np.diff(p[:, :3, 3], axis=0), axis=-1).sum() for p in (matrices, POSES))
    assert track == pytest.approx(units * true, rel=0.02)
    said = capsys.readouterr().out
    assert f"Depths: depth images of {COUNT} photos: they agree to " in said
    for frame in meta["frames"]:
        file, stem = scene / frame["depth_file_path"], Path(frame["file_path"]).stem
        truth = units * corridor.depth(POSES[int(stem[-3:]) - 1])
        for factor in (1, 2):
            path = file if factor == 1 else scene / "depths_2" / file.name
            rendered = read_depth_image(path, 1e-3)  # as nerfstudio does
            right = truth[factor // 2 :: factor, factor // 2 :: factor]
            assert rendered.shape == right.shape and (rendered[: 40 // factor, : 40 // factor] == 0).all()
            assert np.median(rendered[80 // factor :] / right[80 // factor :]) == pytest.approx(1, abs=0.02)
        if not known:
            assert file.read_bytes() == (given / file.name).read_bytes()
            assert meta["mmpi_prepare"]["unit"].startswith(f"1 metre, from depth images of {COUNT} photos")
        assert file.suffix == (".npy" if known else ".png")


def test_depths_of_other_images_are_refused(frames, tmp_path):
    turned = write_depths(tmp_path / "depths", POSES)
    for file in turned.iterdir():
        Image.fromarray(np.asarray(Image.open(file))[::-1, ::-1]).save(file)
    with pytest.raises(InputError, match="--depths contradict the model by"):
        prepare(Settings(frames, tmp_path / "scene", depths=turned, moving="keep", threads=1, focal=corridor.FOCAL))


def test_depths_that_do_not_match_names_or_sizes_are_refused(tmp_path):
    photos = [Photo(f"a/frame_{i:03d}.color.jpg", 240, 160, source=f"a/frame_{i:03d}.color.jpg") for i in (1, 2)]
    folder = write_depths(tmp_path / "depths", POSES[:1])
    with pytest.raises(InputError, match=r"no depth image for 1 of 2 images .*frame_002"):
        find_depths(folder, photos)
    assert find_depths(folder, photos[:1]) == {photos[0].name: folder / "frame_001.png"}
    with pytest.raises(InputError, match=r"240x160, its image .* 160x240"):
        find_depths(folder, [Photo("frame_001.png", 160, 240, source="frame_001.png")])
    half = [Photo("frame_001.png", 480, 320, source="frame_001.png")]
    assert find_depths(folder, half), "a sensor of fewer pixels"
    for name in ("a", "b"):  # of two folders: those of the image's own
        write_depths(folder / name, POSES[:1])
    assert find_depths(folder, photos[:1]) == {photos[0].name: folder / "a/frame_001.png"}


def test_depths_of_tum_are_the_nearest_in_time_and_those_without_are_left_out(frames, tmp_path, capsys):
    for kind in ("rgb", "depth"):
        (tmp_path / kind).mkdir()
    for i, at in enumerate((0.0, 0.013, -0.019, 0.025, 0.0)):
        shutil.copyfile(frames / f"frame_{i + 1:03d}.png", tmp_path / f"rgb/130503110{i}.175304.png")
        values = np.full((corridor.HEIGHT, corridor.WIDTH), 5000 * (i + 1), np.uint16)
        Image.fromarray(values).save(tmp_path / f"depth/{1305031100.175304 + i + at:.6f}.png")
    (tmp_path / "depth.txt").write_text("# depth maps")
    run = Preparation(Settings(tmp_path / "rgb", tmp_path / "scene", depths=tmp_path / "depth", focal=corridor.FOCAL))
    run.work.mkdir(parents=True)
    run._read()
    assert [p.name[9] for p in run.photos] == ["0", "1", "2", "4"]
    for photo in run.photos:
        assert np.allclose(read_millimetres(run.depths[photo.name]), 1000 * (int(photo.name[9]) + 1))
    assert "1 images have no depths within 0.02 s: left out (1305031103.175304.png)" in capsys.readouterr().out
    files = write_depths_of_scene(run.depths, run.photos, 1.0, tmp_path / "built", [])
    assert np.load(tmp_path / "built" / files[run.photos[1].name])[0, 0] == pytest.approx(2000)
    (tmp_path / "depth.txt").unlink()
    assert read_millimetres(run.depths[run.photos[1].name])[0, 0] == 10000
    for file in sorted((tmp_path / "depth").iterdir())[:3]:
        file.unlink()
    with pytest.raises(InputError, match="no depth image for 4 of 5 images"):
        run._read()


def test_integers_are_millimetres_and_other_numbers_metres(tmp_path):
    np.save(tmp_path / "metres.npy", np.array([[1.5, np.nan], [-1, np.inf]], np.float32)[..., None])
    assert read_millimetres(tmp_path / "metres.npy").tolist() == [[1500, 0], [0, 0]]
    np.save(tmp_path / "whole.npy", np.array([[1500, 0], [0, 7]], np.uint16))
    assert read_millimetres(tmp_path / "whole.npy").tolist() == [[1500, 0], [0, 7]]
    Image.fromarray(np.full((4, 4), 99, np.uint8)).save(tmp_path / "gray.png")
    with pytest.raises(InputError, match="not one channel of depths"):
        read_millimetres(tmp_path / "gray.png")
    (tmp_path / "bad.png").write_bytes(b"x")
    with pytest.raises(InputError, match="not one channel"):
        read_millimetres(tmp_path / "bad.png")
    (tmp_path / "bad.npy").write_bytes(b"x")
    with pytest.raises(InputError, match="cannot be read"):
        read_millimetres(tmp_path / "bad.npy")
