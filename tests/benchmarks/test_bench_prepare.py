"""benchmarks/prepare.py: what counts as wrong, and that a false green is counted as one."""

from __future__ import annotations

import json

import numpy as np
import pytest
from captures import Capture, Truth, catalogue
from prepare import compare, headline, markdown


def track(count=12):
    """A bend that is driven. [N, 3] centres, [N, 3, 3] camera to world with OpenCV axes."""
    turns = 0.05 * np.arange(count)
    rotations = np.array([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in turns])
    return np.cumsum(rotations[:, :, 2], axis=0), rotations


def scene_with(folder, centers, rotations, names):
    """A transforms.json with these poses, in another frame and unit."""
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    frames = []
    for name, center, rotation in zip(names, centers, rotations, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = turn @ rotation * [1, -1, -1]
        pose[:3, 3] = 0.2 * turn @ center + [3, -1, 2]
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 351.0, "frames": frames[::-1]}))
    return folder


@pytest.mark.parametrize(("shift", "is_wrong"), [(0.0, False), (4.0, True)])
def test_errors_are_those_after_the_best_similarity(tmp_path, shift, is_wrong):
    centers, rotations = track()
    names = tuple(f"{i:02d}.png" for i in range(len(centers)))
    truth = Truth(names, centers, rotations, 360.0)
    found = centers.copy()
    found[7:, 2] += shift
    row = compare(scene_with(tmp_path / "scene", found, rotations, names), truth)
    assert row["registered"] == 12 and row["focal"] == 351.0 and row["track"] == pytest.approx(11)
    assert row["is_wrong"] == is_wrong and row["turn_mean"] < 1e-4
    assert (row["center_max"] < 1e-9) == (not shift)


def test_a_constant_turn_of_all_cameras_alone_is_an_error_of_rotations_not_of_centres(tmp_path):
    centers, rotations = track()
    names = tuple(f"{i:02d}.png" for i in range(len(centers)))
    tilt = np.array([[1, 0, 0], [0, np.cos(0.02), -np.sin(0.02)], [0, np.sin(0.02), np.cos(0.02)]])
    row = compare(scene_with(tmp_path / "s", centers, rotations @ tilt, names), Truth(names, centers, rotations, 1.0))
    assert row["center_max"] < 1e-9 and 0 < row["turn_mean"] < np.degrees(0.02)


def test_false_greens_and_false_reds_are_counted():
    rows = [
        {"grade": "right", "is_wrong": False},
        {"grade": "right", "is_wrong": True},
        {"grade": "right"},  # green without a scene
        {"grade": "doubtful", "is_wrong": False},
        {"grade": "refused", "is_wrong": True},
        {"grade": "refused"},
    ]
    assert headline(rows) == {"captures": 6, "right": 1, "false_green": 2, "false_red": 1}


def test_page_shows_what_was_said_of_a_refused_capture_and_what_did_not_run():
    row = {"grade": "refused", "says": "mmpi-prepare: broken.", "seconds": 9.6, "cpu_seconds": 8.2, "images": 64}
    row |= {"commit": "abc1234"}
    rows = {"fern": row | {"registered": 0, "focal_true": 815.0}, "fox": {"not_run": "it is not there"}}
    made = {"command": "c", "processor": "p", "threads": 1, "torch": "t", "commit": "h", "date": "d"}
    text = markdown(rows, headline([rows["fern"]]), made)
    assert "| fern | 0 of 64 | - | - | nan, 815.0 | refused | 10 s | 8 s | abc1234 |" in text
    assert "- fern: mmpi-prepare: broken." in text and "fox: it is not there" in text


def test_every_capture_comes_whole_at_half_size_and_every_second_frame():
    found = catalogue()
    assert len(found) == 3 * (1 + 5 + 3 + 4)
    assert found["long-road-2-second"].start == 64 and found["long-road-2-second"].step == 2


def test_procedural_capture_knows_the_cameras_of_the_images_it_writes(tmp_path):
    capture = Capture("orbit", "object", False, step=16, half=True, count=48)
    truth = capture.write(tmp_path, tmp_path / "images")
    assert [p.name for p in sorted((tmp_path / "images").iterdir())] == list(truth.names)
    assert len(truth.names) == 3 and truth.focal == pytest.approx(1.05 * 640 / 2)
    toward = -truth.centers / np.linalg.norm(truth.centers, axis=-1, keepdims=True)
    assert (np.einsum("ni,ni->n", truth.rotations[:, :, 2], toward) > 0.9).all()  # all look at the middle


def test_a_capture_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"transforms\.json is not there"):
        catalogue()["fern"].write(tmp_path, tmp_path / "images")
