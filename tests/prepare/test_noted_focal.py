"""EXIF's focal length where the images hardly determine one."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from test_prepare_parts import model_of

from mmpi_prepare.adjustment import keeps_focals, open_focals, with_focals

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
    tracks = [pycolmap.Track() for _ in points]
    for i, image in sorted(model.images.items()):
        local = (points - poses[i - 1, :3, 3]) @ poses[i - 1, :3, :3]
        pixels = np.asarray(lens.img_from_cam(local)) + random.normal(0, 0.5, (600, 2))
        seen = np.flatnonzero(((pixels > 0) & (pixels < [200, 160])).all(-1))
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels[seen]])
        for slot, p in enumerate(seen):
            tracks[p].add_element(i, slot)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 2:
            model.add_point3D(point * [1, 1, focal / TRUE], track, np.zeros(3, np.uint8))
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
