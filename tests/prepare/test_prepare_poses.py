"""Known poses: each format, points from them, refinement, and what is said when they do not fit."""

from __future__ import annotations

import json
from dataclasses import replace

import corridor
import numpy as np
import pycolmap
import pytest

from mmpi_ns.utils.errors import InputError
from mmpi_prepare.adjustment import camera_poses
from mmpi_prepare.images import Photo
from mmpi_prepare.pipeline import prepare
from mmpi_prepare.poses import opencv_intrinsics, read_poses
from mmpi_prepare.settings import Settings

COUNT = 8
GIVEN = corridor.poses(COUNT)
PHOTOS = [Photo(f"frame_{i + 1:03d}.png", 240, 160, source=f"frame_{i + 1:03d}.png") for i in range(COUNT)]
FLIP = np.diag([1.0, -1, -1, 1])


def write_kitti(path, poses):
    path.write_text("".join(" ".join(f"{v:.12g}" for v in p[:3].ravel()) + "\n" for p in poses))
    return path


def write_tum(path, poses, times):
    lines = ["# time tx ty tz qx qy qz qw"]
    for time, pose in zip(times, poses, strict=True):
        quaternion = pycolmap.Rotation3d(pose[:3, :3]).quat
        lines.append(" ".join(f"{v:.12g}" for v in (time, *pose[:3, 3], *quaternion)))
    path.write_text("\n".join(lines))
    return path


def write_matrices(folder, poses):
    folder.mkdir()
    for photo, pose in zip(PHOTOS, poses, strict=True):
        np.savetxt(folder / photo.name.replace(".png", ".pose.txt"), pose)
    return folder


def write_transforms(path, poses, **more):
    frames = [
        {"file_path": f"elsewhere/{photo.name}", "transform_matrix": (pose @ FLIP).tolist()}
        for photo, pose in zip(PHOTOS, poses, strict=True)
    ]
    lens = {"fl_x": 340.0, "fl_y": 340.0, "cx": 240.0, "cy": 160.0, "w": 480, "h": 320}
    path.write_text(json.dumps({**lens, "frames": frames[::-1], **more}))
    return path


def read(path, photos=PHOTOS):
    known = read_poses(path, "auto", photos)
    return known, np.array([known.poses[p.name] for p in photos if p.name in known.poses])


@pytest.mark.parametrize("form", ["kitti", "tum", "matrices", "transforms"])
def test_every_format_gives_the_same_poses(form, tmp_path):
    path = tmp_path / ("poses" if form == "matrices" else "poses.json" if form == "transforms" else "poses.txt")
    times = np.arange(COUNT) * 0.1
    write = {"kitti": write_kitti, "matrices": write_matrices, "transforms": write_transforms}.get(form)
    write(path, GIVEN) if write else write_tum(path, GIVEN, times)
    assert read(path)[1] == pytest.approx(GIVEN, abs=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_map_coordinates_get_an_origin_among_the_cameras(scale, tmp_path):
    poses = GIVEN.copy()
    poses[:, :3, 3] = scale * poses[:, :3, 3] + [4e5, 5.4e6, 100]
    places = read(write_kitti(tmp_path / "poses.txt", poses))[1][:, :3, 3]
    assert places - places[0] == pytest.approx(poses[:, :3, 3] - poses[0, :3, 3], abs=1e-2)
    assert np.abs(places).max() < 2 * np.ptp(places, axis=0).max()


@pytest.mark.parametrize(("numbers", "first"), [((3, 10, 25), 0), ((3, 10, 30), 1)])
def test_kitti_lines_are_chosen_by_the_images_numbers_where_there_are_more(numbers, first, tmp_path):
    path = write_kitti(tmp_path / "poses.txt", corridor.poses(30))
    photos = [Photo(f"{n:06d}.png", 9, 9, source=f"{n:06d}.png") for n in numbers]
    wanted = corridor.poses(30)[[n - first for n in numbers]]
    assert read(path, photos=photos)[1] == pytest.approx(wanted, abs=1e-9)
    with pytest.raises(InputError, match="cannot be matched"):
        read(path, photos=[replace(photo, source=f"{30 + n}.png") for n, photo in enumerate(photos)])


def test_tum_poses_are_matched_by_time_stamp(tmp_path):
    times = 100 + np.arange(COUNT) * 0.1
    path = write_tum(tmp_path / "poses.txt", GIVEN, times)
    photos = [Photo(f"{t + 0.01:.3f}.png", 9, 9, source=f"{t + 0.01:.3f}.png") for t in (times[5], times[2])]
    assert read(path, photos=photos)[1] == pytest.approx(GIVEN[[5, 2]], abs=1e-9)


def test_frame_numbers_are_no_seconds(tmp_path):
    for times in (np.arange(COUNT), np.arange(COUNT) + 1, np.arange(COUNT) * 0.5):  # of frames 1 to COUNT
        assert read(write_tum(tmp_path / "poses.txt", GIVEN, times))[1] == pytest.approx(GIVEN, abs=1e-9)
    path = write_tum(tmp_path / "poses.txt", GIVEN, np.arange(COUNT) + 1)
    assert read(path, photos=[PHOTOS[5], PHOTOS[2]])[1] == pytest.approx(GIVEN[[5, 2]], abs=1e-9)
    with pytest.raises(InputError, match="not their time stamps"):
        read(write_tum(tmp_path / "poses.txt", GIVEN, np.arange(COUNT) * 0.5), photos=PHOTOS[:3])


def test_transforms_bring_intrinsics_scaled_to_the_images_and_their_split(tmp_path):
    lists = {"train_filenames": ["images/frame_001.png"], "test_filenames": ["images/frame_002.png"]}
    lens = {"fl_y": 350.0, "cx": 236.0, "cy": 162.0, "k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": 0.5}
    path = tmp_path / "transforms.json"
    known, _ = read(write_transforms(path, GIVEN, **lens, **lists))  # of images twice as large
    wanted = [170.0, 175.0, 118.0, 81.0, 0.1, 0.2]
    assert opencv_intrinsics(known.intrinsics["frame_001.png"]) == ([*wanted, 0.3, 0.4, 0.5], False)
    assert known.split is not None and known.split["test_filenames"] == lists["test_filenames"]
    known, _ = read(write_transforms(path, GIVEN, **lens, k4=0.6, camera_model="OPENCV_FISHEYE"))
    assert opencv_intrinsics(known.intrinsics["frame_008.png"]) == ([*wanted, 0.5, 0.6, 0.0], True)
    assert known.split is None
    renamed = [replace(p, name=f"left-{p.name}", source=f"left/{p.name}") for p in PHOTOS]
    lists = {key: [f"elsewhere/frame_00{n}.png"] for n, key in enumerate(lists, 1)}
    known = read_poses(write_transforms(path, GIVEN, **lists), "auto", renamed)
    assert known.split == {"train_filenames": ["left-frame_001.png"], "test_filenames": ["left-frame_002.png"]}
    with pytest.raises(InputError, match=r"^frame_001\.png is 240x160"):
        read(write_transforms(path, GIVEN, w=400))
    with pytest.raises(InputError, match="a k4, which"):
        read(write_transforms(path, GIVEN, k4=0.6))
    meta = json.loads(write_transforms(path, GIVEN).read_text())
    path.write_text(json.dumps(meta | {"frames": [f | {"fl_x": 999.0} for f in meta["frames"]]}))
    assert read(path)[0].intrinsics["frame_001.png"].params[0] == 170.0  # nerfstudio reads the one for all
    known, _ = read(write_transforms(path, GIVEN, distortion_params=[0.1, 0.2, 0.5, 0.0, 0.3, 0.4]))
    assert opencv_intrinsics(known.intrinsics["frame_001.png"])[0][4:] == [0.1, 0.2, 0.3, 0.4, 0.5]
    some = [f | {"fl_x": 999.0} for f in meta["frames"][:3]] + meta["frames"][3:]
    path.write_text(json.dumps({"frames": some}))
    with pytest.raises(InputError, match="no fl_x, as"):
        read(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2 3\n", "not understood"),
        ("1 0 0 0 0 1 0 0 0 0 1 x\n", "'x' to float64 at row 0"),
        ("# nothing", "not understood"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "3 poses for 8 images"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n" * 8, "no rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n" * 8, "no rotation"),
    ],
)
def test_poses_that_make_no_sense_are_named(text, words, tmp_path):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(InputError, match=words):
        read(tmp_path / "poses.txt")


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("poses") / "frames"
    corridor.write_images(folder, COUNT)
    return folder


def scene_poses(scene):
    frames = json.loads((scene / "transforms.json").read_text())["frames"]
    return np.array([f["transform_matrix"] for f in frames]) @ FLIP


def errors(poses):
    """(largest distance in metres, largest angle in degrees) from the true poses."""
    cosines = (np.einsum("nij,nij->n", poses[:, :3, :3], GIVEN[:, :3, :3]) - 1) / 2
    return np.linalg.norm(poses[:, :3, 3] - GIVEN[:, :3, 3], axis=-1).max(), np.degrees(
        np.arccos(np.clip(cosines, -1, 1)).max()
    )


def test_points_are_triangulated_and_given_poses_kept(frames, tmp_path):
    poses = write_kitti(tmp_path / "poses.txt", GIVEN)
    prepare(Settings(frames, tmp_path / "scene", poses=poses, focal=corridor.FOCAL, threads=1))
    model = pycolmap.Reconstruction(tmp_path / "scene/colmap/sparse/0")
    assert scene_poses(tmp_path / "scene") == pytest.approx(GIVEN, abs=1e-9)
    assert model.num_points3D() > 300 and model.compute_mean_reprojection_error() < 0.4
    floor = [p.xyz[2] for p in model.points3D.values() if p.track.length() > 3]
    assert np.min(np.abs(floor)) < 0.05 and np.percentile(floor, 1) > -0.15  # nothing below the floor


def test_refining_brings_disturbed_poses_back(frames, tmp_path):
    rng = np.random.default_rng(0)
    disturbed = GIVEN.copy()
    disturbed[:, :3, 3] += rng.normal(0, 0.01, (COUNT, 3))
    for pose in disturbed:
        axis = rng.normal(0, np.radians(0.4), 3)
        pose[:3, :3] = pycolmap.Rotation3d(axis).matrix() @ pose[:3, :3]
    poses = write_kitti(tmp_path / "poses.txt", disturbed)
    settings = Settings(frames, tmp_path / "scene", poses=poses, focal=corridor.FOCAL, refine_poses=True, threads=1)
    prepare(settings)
    moved, turned = errors(scene_poses(tmp_path / "scene"))
    was_moved, was_turned = errors(disturbed)
    assert turned < 0.5 * was_turned and moved < was_moved
    assert "poses moved by" in (tmp_path / "scene/report.md").read_text()


def test_poses_with_other_axes_are_read_so_or_refused_where_axes_were_given(frames, tmp_path, capsys):
    poses = write_kitti(tmp_path / "poses.txt", np.linalg.inv(GIVEN @ FLIP))
    how = Settings(frames, tmp_path / "scene", poses=poses, focal=corridor.FOCAL, threads=1, keep_work=True)
    assert prepare(how).grade == "right"
    with pytest.raises(InputError, match="--poses-axes"):  # not the model that is kept
        prepare(replace(how, poses_axes="opencv", overwrite=True))
    said = "have OpenGL's camera axes (x right, y up, z back) and are world to camera, not camera to world"
    assert said in capsys.readouterr().out.replace("\n", " ")
    model = pycolmap.Reconstruction(tmp_path / "scene/colmap/sparse/0")
    assert camera_poses(model)[1] == pytest.approx(GIVEN, abs=1e-6)


def test_known_poses_want_intrinsics(frames, tmp_path):
    poses = write_kitti(tmp_path / "poses.txt", GIVEN)
    with pytest.raises(InputError, match="--focal or --camera"):
        prepare(Settings(frames, tmp_path / "scene", poses=poses, threads=1))
