"""People as OpenCV's detector sees them: what stands on the ground and no static scene explains is masked."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mmpi_ns.data.checks import say_once
from mmpi_priors import moving
from mmpi_priors.dense import Depth
from mmpi_priors.moving_evidence import Evidence, Shot
from mmpi_priors.moving_objects import SURE, grown
from mmpi_priors.people import horizon_of, people_in
from mmpi_priors.tracks import PosedImages
from mmpi_priors.upright import upright
from mmpi_priors.views import load_view, straightened_color

WIDTH, HEIGHT, TALL = 640, 480, 120
UP = np.array([0.0, 1.0, 0.0])
COLUMN, FEET = 200, 340


def figure(column, feet, tall=TALL):
    """A dark figure on its feet before a wall and a road. [HEIGHT, WIDTH]"""
    big, unit = 4, tall / 2
    image = (
        np.random.default_rng(0).normal(0, 4, (HEIGHT, WIDTH)) + np.where(np.arange(HEIGHT) < 240, 170, 140)[:, None]
    )
    image = cv2.GaussianBlur(image.clip(0, 255).astype(np.uint8), (0, 0), 1)
    canvas = cv2.resize(image, None, fx=big, fy=big)

    def at(x, y):
        return int(column * big + x * unit), int((feet - tall) * big + y * unit)

    for x, y, w, h in ((0, 0.5, 0.38, 0.5), (0, 2.3, 0.8, 1.5), (-0.75, 2.4, 0.22, 1.4), (0.75, 2.4, 0.22, 1.4)):
        cv2.ellipse(canvas, at(x, y), (int(w * unit), int(h * unit)), 0, 0, 360, (40,), -1)
    for side in (-1, 1):
        cv2.line(canvas, at(0.3 * side, 3.6), at(0.45 * side, 8), (40,), int(0.5 * unit))
    return cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def of_a_level_camera(folder, image, pitch=0.0):
    """The image as that of a camera whose horizon is its middle row, or which looks so many degrees down."""
    cv2.imwrite(str(folder / "image.png"), image)
    c, s = np.cos(np.radians(pitch)), np.sin(np.radians(pitch))
    pose = np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0]], float)
    size, pinhole = np.array([[WIDTH, HEIGHT]], float), np.array([[500, 500, WIDTH / 2, HEIGHT / 2]], float)
    images = PosedImages((folder / "image.png",), pose[None], pinhole, size, np.zeros((1, 4)), False)
    return images, load_view(images, 0, 384)


def found(folder, image, pitch=0.0):
    images, view = of_a_level_camera(folder, image, pitch)
    people = people_in(images, 0, view, UP)
    assert (people.scores > 0).all() and len(people.scores) == len(people.boxes)
    return people.boxes[people.scores > SURE] * WIDTH / 384


def test_the_horizon_is_where_what_lies_level_appears(tmp_path):
    for pitch in (0.0, 10.0):
        _, view = of_a_level_camera(tmp_path, figure(COLUMN, FEET), pitch)
        expected = (HEIGHT / 2 - 500 * np.tan(np.radians(pitch))) * 384 / WIDTH
        np.testing.assert_allclose(horizon_of(view, UP), expected, atol=1e-6)
    assert horizon_of(of_a_level_camera(tmp_path, figure(COLUMN, FEET), 80.0)[1], UP) is None


@pytest.mark.parametrize(("direction", "tilt"), [([0, 0, -1], 0.0), ([0, 1, 0], 6.0)], ids=["ahead", "up"])
def test_cameras_that_all_look_down_on_a_level_path_do_not_tilt_the_world(direction, tilt):
    c, s = np.cos(np.radians(6.0)), np.sin(np.radians(6.0))
    poses = np.tile(np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0]], float), (5, 1, 1))
    poses[:, :, 3] = np.arange(5)[:, None] * np.array(direction)
    assert np.degrees(np.arccos(min(1, upright(poses) @ UP))) == pytest.approx(tilt, abs=1e-4)


def test_cameras_that_turn_tell_what_is_up_though_all_look_up():
    poses = np.zeros((11, 3, 4))
    for pose, angle in zip(poses, np.linspace(0, 1.2, 11), strict=True):
        right = np.array([np.cos(angle), 0, np.sin(angle)])
        ahead = np.array([np.sin(angle), 0.15, -np.cos(angle)]) / np.sqrt(1 + 0.15**2)
        pose[:, :3] = np.stack([right, np.cross(right, ahead), -ahead], -1)
        pose[:, 3] = 5 * right
    assert upright(poses) == pytest.approx(UP, abs=1e-9)


def test_a_figure_on_the_ground_is_a_person(tmp_path):
    boxes = found(tmp_path, figure(COLUMN, FEET))
    assert len(boxes) == 1
    assert np.abs(boxes[0] - [COLUMN - 25, FEET - TALL, COLUMN + 25, FEET]).max() < 0.3 * TALL


@pytest.mark.parametrize("feet", [200, 460], ids=["above the horizon", "twice as low as the camera is high"])
def test_what_does_not_stand_on_the_ground_is_none(tmp_path, feet):
    assert len(found(tmp_path, figure(COLUMN, feet))) == 0


def test_nobody_is_searched_where_the_camera_looks_down_or_the_image_is_small(tmp_path):
    assert found(tmp_path, figure(COLUMN, FEET), 80.0).shape == (0, 4)
    assert found(tmp_path, np.full((HEIGHT, WIDTH), 90, np.uint8)).shape == (0, 4)


def test_where_opencv_has_no_detector_nobody_is_searched_and_it_is_said(tmp_path, monkeypatch, capsys):
    monkeypatch.delattr(cv2, "HOGDescriptor")
    say_once.cache_clear()
    assert found(tmp_path, figure(COLUMN, FEET)).shape == (0, 4)
    assert f"OpenCV {cv2.__version__} has no detector" in " ".join(capsys.readouterr().out.split())


def test_masks_made_without_a_detector_are_made_again_with_one(tmp_path, monkeypatch):
    """Nothing else changes, so that without a detector in the key the first masks would be taken from the cache."""
    searches = []
    images, view = of_a_level_camera(tmp_path, figure(COLUMN, FEET))

    def search(*_, progress):
        searches.append(hasattr(cv2, "HOGDescriptor"))
        return [view], [np.zeros(view.gray.shape, bool)], ""

    monkeypatch.setattr(moving, "posed_images", lambda *_: images)
    monkeypatch.setattr(moving, "find_moving", search)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    seen = SimpleNamespace(sizes=[(WIDTH, HEIGHT)], tracked=(np.zeros(0, int), np.zeros((0, 3))))
    with monkeypatch.context() as without:
        without.delattr(cv2, "HOGDescriptor")
        for _ in range(2):
            moving.moving_masks(seen, [])
    for _ in range(2):
        moving.moving_masks(seen, [])
    assert searches == [False, True]


@pytest.mark.parametrize(
    ("score", "seen", "is_static", "masked"),
    [(0.7, 0.0, False, True), (0.7, 1.0, True, False), (0.1, 0.0, False, False), (0.1, 0.4, False, True)],
    ids=["sure", "its depth explains it", "unsure", "unsure and seen to move"],
)
def test_a_person_is_masked_if_sure_or_seen_to_move_unless_its_depth_explains_it(
    tmp_path, score, seen, is_static, masked
):
    """Seen to move in a share of its rows."""
    images, view = of_a_level_camera(tmp_path, figure(COLUMN, FEET))
    inverse = np.full(view.gray.shape, float(is_static), np.float32)
    nothing = np.zeros(view.gray.shape, np.uint8)
    people = people_in(images, 0, view, UP)
    assert len(people.boxes) == 1 and people.scores[0] > SURE
    strong = nothing.copy()
    top, bottom = people.boxes[0, [1, 3]]
    strong[top : top + round(seen * (bottom - top))] = 50
    color = np.asarray(straightened_color(images, 0, view), np.uint8)
    shot = Shot(view, color, Depth(inverse, 0.01 * inverse), None, None, replace(people, scores=np.array([score])))
    mask = grown(shot, Evidence(strong, nothing, nothing, nothing == 0, 0.0), nothing > 0)
    truth = view.gray < 90
    if masked:
        assert mask[truth].mean() > 0.7 and mask[~truth].mean() < 0.01
    else:
        assert not mask.any()
