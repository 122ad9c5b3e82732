"""Parts of mmpi-prepare by themselves: pairs, the scene's frame, lenses, and what the files hold."""

from __future__ import annotations

import corridor
import cv2
import numpy as np
import pycolmap
import pytest

from mmpi_ns.utils.errors import InputError
from mmpi_prepare import export, features
from mmpi_prepare.adjustment import (
    adjust,
    choose_frame,
    keeps_focals,
    open_focals,
    polish,
    quality,
    similarity_between,
    turns_back,
    with_focals,
)
from mmpi_prepare.images import Photo
from mmpi_prepare.poses import make_cameras, opencv_camera, opencv_intrinsics
from mmpi_priors.sfm import rigid3d


def model_of(poses, *cameras):
    """A model of posed images without points; images take the cameras in turn."""
    model = pycolmap.Reconstruction()
    cameras = cameras or (pycolmap.Camera(model="PINHOLE", width=8, height=6, params=[9, 9, 4, 3], camera_id=1),)
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for i, pose in enumerate(poses):
        camera = cameras[i % len(cameras)]
        image = pycolmap.Image(name=f"{i}.jpg", camera_id=camera.camera_id, image_id=i + 1)
        model.add_image_with_trivial_frame(image, rigid3d(pose))
    return model


def add_points(model, points, lens, poses, noise, random, stretch=1.0):
    """Points that three images or more see through a lens, with keypoints that are off by so many pixels; the model has
    them so many times as far ahead."""
    tracks = [pycolmap.Track() for _ in points]
    for i, image in sorted(model.images.items()):
        local = (points - poses[i - 1, :3, 3]) @ poses[i - 1, :3, :3]
        pixels = np.asarray(lens.img_from_cam(local)) + random.normal(0, noise, (len(points), 2))
        seen = np.flatnonzero((local[:, 2] > 1) & ((pixels > 0) & (pixels < [lens.width, lens.height])).all(-1))
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels[seen]])
        for slot, p in enumerate(seen):
            tracks[p].add_element(i, slot)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 2:
            model.add_point3D(point * [1, 1, stretch], track, np.zeros(3, np.uint8))


# Pairs ---------------------------------------------------------------------------------------------------------------


def test_a_sequence_is_matched_with_near_and_far_frames_and_where_it_comes_back():
    place = np.arange(120.0)
    place[115:] = place[:5]  # comes back to its start
    alike = np.exp(-((place[:, None] - place) ** 2) / 50).astype(np.float32)
    np.fill_diagonal(alike, -1)
    names = [str(i) for i in range(120)]
    actual, summary = features.choose_pairs("sequential", names, alike, 4, False)
    steps = {j - i for i, j in actual if j < 115}
    assert steps == {1, 2, 3, 4, 15, 20, 30, 45}
    assert sum(j - i == 45 for i, j in actual) == 120 - 45
    assert {(i, 115 + i) for i in range(5)} <= set(actual)
    again = sum(j - i > 45 for i, j in actual)
    assert summary == f"sequential (as asked), {again} pairs that may be revisits"
    assert len(features.choose_pairs("exhaustive", names[:7], alike[:7, :7], 4, False)[0]) == 21


# The scene's frame ---------------------------------------------------------------------------------------------------


def test_without_metres_the_track_is_one_unit_long_about_the_origin_and_heads_along_y():
    turn = pycolmap.Rotation3d(np.array([0.3, -0.5, 0.9])).matrix()
    poses = corridor.poses(9, bend=0.02)
    moved = np.tile(np.eye(4), (9, 1, 1))
    moved[:, :3, :3], moved[:, :3, 3] = turn @ poses[:, :3, :3], 7 * poses[:, :3, 3] @ turn.T + [3, -2, 5]
    similarity, _, unit = choose_frame(model_of(moved), None)
    centers = np.array([similarity * c for c in moved[:, :3, 3]])
    rotations = similarity.rotation.matrix() @ moved[:, :3, :3]
    assert centers.mean(0) == pytest.approx([0, 0, 0], abs=1e-9)
    along = np.linalg.svd(centers)[2][0]
    assert np.ptp(centers @ along) == pytest.approx(1)
    assert rotations[:, 2, 1] == pytest.approx(np.full(9, -1.0))  # down in the image is down
    assert rotations[0, :, 2] == pytest.approx([0, 1, 0], abs=1e-9)
    assert centers[-1, 1] > centers[0, 1] + 0.9 and "extent" in unit


def test_up_is_found_by_cameras_that_look_down_on_a_turn():
    poses = np.tile(np.eye(4), (9, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 2, 9), strict=True):
        right = np.array([np.cos(angle), -np.sin(angle), 0])
        forward = np.array([np.sin(angle), np.cos(angle), -0.6]) / np.sqrt(1.36)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
    assert choose_frame(model_of(poses), None)[0].rotation.matrix()[2] == pytest.approx([0, 0, 1], abs=1e-9)
    straight = corridor.poses(5, bend=0.0)
    assert choose_frame(model_of(straight), None)[0].rotation.matrix()[2] == pytest.approx([0, 0, 1], abs=1e-9)


def test_up_is_found_by_few_turns_if_cameras_are_hardly_rolled():
    """A bend of 70 degrees, filmed from below: the mean of the cameras' up leans back, their right vectors do not."""
    poses = np.tile(np.eye(4), (11, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 1.2, 11), strict=True):
        right = np.array([np.cos(angle), -np.sin(angle), 0])
        forward = np.array([np.sin(angle), np.cos(angle), 0.15]) / np.sqrt(1 + 0.15**2)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
    assert choose_frame(model_of(poses), None)[0].rotation.matrix()[2] == pytest.approx([0, 0, 1], abs=1e-9)


def test_a_straight_track_is_fitted_without_a_turn_about_itself():
    straight = corridor.poses(6, bend=0.0)
    straight[:, 0, 3] = 0
    turn = pycolmap.Rotation3d(np.array([0.4, 1.1, -0.2])).matrix()
    target = straight.copy()
    target[:, :3, :3] = turn @ straight[:, :3, :3]
    target[:, :3, 3] = 2.5 * straight[:, :3, 3] @ turn.T + [1, 2, 3]
    actual = similarity_between(straight, target)
    assert actual.scale == pytest.approx(2.5) and actual.rotation.matrix() == pytest.approx(turn)
    assert actual.translation == pytest.approx([1, 2, 3])


# Lenses --------------------------------------------------------------------------------------------------------------

SIZE = {"width": 200, "height": 160, "camera_id": 1}


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [150, 98, 83]),
        ("PINHOLE", [150, 140, 98, 83]),
        ("SIMPLE_RADIAL", [150, 98, 83, 0.1]),
        ("RADIAL", [150, 98, 83, 0.1, -0.05]),
        ("OPENCV", [150, 140, 98, 83, 0.1, -0.05, 0.02, -0.01]),
        ("FULL_OPENCV", [150, 140, 98, 83, 0.1, -0.05, 0.02, -0.01, 0.3, 0, 0, 0]),
        ("OPENCV_FISHEYE", [150, 140, 98, 83, 0.1, -0.05, 0.02, -0.01]),
    ],
)
def test_a_lens_of_colmap_projects_as_opencv_says(model, params):
    camera = pycolmap.Camera(model=model, params=params, **SIZE)
    (fx, fy, cx, cy, *terms), is_fisheye = opencv_intrinsics(camera)
    rays = np.array([[0.3, -0.2, 1.0], [-0.4, 0.35, 1.0], [0.1, 0.4, 1.0]])
    matrix, still = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    project = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
    args = (still, still, matrix, np.array(terms[: 4 if is_fisheye else 5]))
    wanted = (project(rays[None], *args) if is_fisheye else project(rays, *args))[0].reshape(-1, 2)
    assert camera.img_from_cam(rays) == pytest.approx(wanted, abs=1e-6)


def test_given_lenses_are_kept_apart_and_come_back_from_colmaps():
    photos = [Photo(name, 200, 160, source=name) for name in "abcd"]
    bent, flat = [150.0, 140.0, 98.0, 83.0, 0.1, -0.05, 0.02, -0.01], [150.0, 140.0, 98.0, 83.0]
    given = {"a": opencv_camera(bent, True), "b": opencv_camera(flat, False), "c": opencv_camera(bent, True)}
    numbers, cameras = make_cameras(photos, "auto", given, 120.0, "auto")
    assert numbers == [1, 2, 1, 3] and [c.camera_id for c in cameras] == [1, 2, 3]
    assert [c.model.name for c in cameras[:2]] == ["OPENCV_FISHEYE", "PINHOLE"]
    assert [opencv_intrinsics(c) for c in cameras[:2]] == [([*bent, 0.0], True), ([*flat, *[0.0] * 5], False)]


# Files ---------------------------------------------------------------------------------------------------------------


def test_images_of_several_cameras_state_their_own_intrinsics():
    cameras = [
        pycolmap.Camera(model="OPENCV_FISHEYE", params=[150 + n, 140, 98, 83, 0.1, -0.05, 0.02, n], width=200,
                        height=160 + n, camera_id=n)
        for n in (1, 2)
    ]  # fmt: skip
    split = export.Split(("0.jpg",), ("1.jpg", "2.jpg"), "")
    content = export.transforms(model_of(corridor.poses(3), *cameras), split, True, {}, {})
    assert content["camera_model"] == "OPENCV_FISHEYE" and "fl_x" not in content
    actual = [[f[k] for k in ("file_path", "mask_path", "fl_x", "h", "k3", "k4")] for f in content["frames"]]
    assert actual == [
        [f"images/{i}.jpg", f"masks/{i}.png", 151 + i % 2, 161 + i % 2, 0.02, 1 + i % 2] for i in range(3)
    ]
    assert content["train_filenames"] == ["images/0.jpg"]
    assert content["test_filenames"] == content["val_filenames"] == ["images/1.jpg", "images/2.jpg"]
    (shared,) = cameras[:1]
    content = export.transforms(model_of(corridor.poses(2), shared), split, False, {}, {})
    assert (
        content["fl_x"] == 151 and content["k4"] == 1 and set(content["frames"][0]) == {"file_path", "transform_matrix"}
    )
    mixed = [shared, pycolmap.Camera(model="PINHOLE", params=[9, 9, 4, 3], width=8, height=6, camera_id=3)]
    with pytest.raises(InputError, match="Fisheye and perspective"):
        export.transforms(model_of(corridor.poses(2), *mixed), split, False, {}, {})


# Mapping -------------------------------------------------------------------------------------------------------------


def test_models_are_sorted_by_soundness_then_images_then_fit_and_large_images_may_be_off_by_more():
    def seen_by(count, noise, size=1):
        random, poses = np.random.default_rng(0), corridor.poses(count)
        lens = size * np.array([150, 150, 100, 80])
        camera = pycolmap.Camera(model="PINHOLE", width=200 * size, height=160 * size, params=lens, camera_id=1)
        model = model_of(poses, camera)
        points = random.uniform([-2, 6, -1], [4, 20, 4], (400, 3))
        add_points(model, points, camera, poses, noise, random)
        model.update_point_3d_errors()
        return quality(model)

    assert seen_by(8, 0.9) < seen_by(5, 0.4) < seen_by(5, 0.2) < seen_by(6, 0.4)
    assert not seen_by(8, 0.9)[0] and seen_by(8, 0.9, size=10)[0]


@pytest.mark.parametrize(("tangential", "kept"), [(0.0, "SIMPLE_RADIAL"), (0.02, "OPENCV")])
def test_four_lens_terms_are_kept_only_where_the_images_bear_them_out(tangential, kept, monkeypatch):
    """Exact points seen through a known lens with noise of a third of a pixel, in a model with one radial term; pixels
    stay square, and a camera of few images keeps one term."""
    random, true = np.random.default_rng(0), [300, 300, 100, 80, 0.1, 0.0, tangential, -tangential]
    lens = pycolmap.Camera(model="OPENCV", params=true, **SIZE)
    poses = corridor.poses(6, bend=0.15)
    points = np.column_stack([random.uniform(-2, 4, 400), random.uniform(6, 20, 400), random.uniform(-1, 4, 400)])
    model = model_of(poses, pycolmap.Camera(model="SIMPLE_RADIAL", params=[300, 100, 80, 0.1], **SIZE))
    add_points(model, points, lens, poses, 1 / 3, random)
    adjust(model, 1, lens=True)
    actual = polish(model, 1, lens=True, full_lens=True, principal_point=False)
    (camera,) = actual.cameras.values()
    assert camera.model.name == kept and model.num_points3D() > 150
    assert camera.params[3 if kept == "SIMPLE_RADIAL" else 4] == pytest.approx(0.1, abs=0.05)
    if tangential:
        assert camera.params[6:] == pytest.approx(true[6:], abs=0.004)
        simple = polish(model, 1, lens=True, full_lens=False, principal_point=False)
        assert [c.model.name for c in simple.cameras.values()] == ["SIMPLE_RADIAL"]
        assert camera.params[0] == camera.params[1]
        monkeypatch.setattr("mmpi_prepare.adjustment.IMAGES_OF_LENS", 7)
        assert polish(model, 1, lens=True, full_lens=True, principal_point=False) is model


def test_a_lens_that_bends_rays_back_is_named():
    """Terms of a tourist's photo."""
    absurd = pycolmap.Camera(model="RADIAL", width=800, height=1200, params=[1000, 400, 600, 0.5, -10.8])
    wide = pycolmap.Camera(model="OPENCV", width=800, height=1200, params=[700, 700, 400, 600, -0.3, 0.12, 0, 0])
    assert turns_back(absurd) and not turns_back(wide)


# EXIF's focal length where the images hardly determine one ------------------------------------------------------------

TRUE, LENS = 300.0, {"model": "SIMPLE_RADIAL", "width": 200, "height": 160, "camera_id": 1}


def a_flight(tilt, focal):
    """A model, with a focal length that may be wrong, of nine images taken from one height, each turned back towards
    the middle by so much; keypoints have noise of half a pixel."""
    random, poses = np.random.default_rng(0), np.tile(np.eye(4), (9, 1, 1))
    poses[:, :2, 3] = 1.5 * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 2)
    for pose in poses:
        ahead = np.array([*(-tilt * pose[:2, 3]), 1.0]) / np.hypot(1, tilt * np.linalg.norm(pose[:2, 3]))
        down = np.cross(ahead, [1.0, 0.0, 0.0])
        down /= np.linalg.norm(down)
        pose[:3, :3] = np.stack([np.cross(down, ahead), down, ahead], -1)
    points = np.column_stack([random.uniform(-4, 4, (600, 2)), random.uniform(8, 10, 600)])
    lens = pycolmap.Camera(params=[TRUE, 100, 80, 0.0], **LENS)
    model = model_of(poses, pycolmap.Camera(params=[focal, 100, 80, 0.0], **LENS))
    add_points(model, points, lens, poses, 0.5, random, focal / TRUE)
    return model


def noting(path, *focals, known=True):
    """A database of features with cameras of these focal lengths."""
    with pycolmap.Database.open(path) as database:
        for focal in focals:
            camera = pycolmap.Camera(params=[focal, 100, 80, 0.0], **LENS)
            camera.has_prior_focal_length = known
            database.write_camera(camera)
    return path


@pytest.mark.parametrize(
    ("tilt", "focal", "noted", "is_open"), [(0.0, 1.3 * TRUE, TRUE, True), (0.1, TRUE, 1.3 * TRUE, False)]
)
def test_only_cameras_that_all_look_the_same_way_leave_the_focal_length_open(
    tilt, focal, noted, is_open, tmp_path, capsys
):
    model = a_flight(tilt, focal)
    assert open_focals(model, noting(tmp_path / "features.db", noted), 1) == ({1: noted} if is_open else {})
    assert ("hardly determine" in capsys.readouterr().out) == is_open
    held = with_focals(model, {1: noted}, 1)
    assert held.cameras[1].mean_focal_length() == noted and model.cameras[1].mean_focal_length() == focal


def test_a_focal_length_near_that_of_exif_is_not_asked_for(tmp_path, capsys):
    assert open_focals(a_flight(0.0, 1.05 * TRUE), noting(tmp_path / "features.db", TRUE), 1) == {}
    assert "EXIF" not in capsys.readouterr().out


def test_only_focal_lengths_of_exif_are_noted(tmp_path, capsys):
    model, database = a_flight(0.0, 1.3 * TRUE), noting(tmp_path / "features.db", TRUE, known=False)
    assert open_focals(model, database, 1) == {} and "EXIF" not in capsys.readouterr().out
    other = noting(noting(tmp_path / "two.db", TRUE), TRUE, known=False)
    assert open_focals(model, other, 1) == {1: TRUE}


@pytest.mark.parametrize(
    ("focal", "known", "keeps"), [(TRUE, True, True), (1.01 * TRUE, True, False), (TRUE, False, False)]
)
def test_a_kept_focal_length_is_that_of_exif(focal, known, keeps):
    camera = pycolmap.Camera(params=[TRUE, 100, 80, 0.0], **LENS)
    camera.has_prior_focal_length = known
    assert keeps_focals(a_flight(0.0, focal), [camera]) == keeps
