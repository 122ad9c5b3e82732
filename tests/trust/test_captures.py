"""Captures that cannot be used: ns-train ends with one sentence that names file, frame and remedy (docs/errors.md)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from forked import run, train
from tiny_scene import HEIGHT, WIDTH, name_of

NAN, INF = math.nan, math.inf
NAME = name_of(3)


def frame(**changes):
    """Sets fields of the fourth frame; ... removes one."""

    def change(meta):
        for key, value in changes.items():
            if value is ...:
                del meta["frames"][3][key]
            else:
                meta["frames"][3][key] = value

    return change


def file(**changes):
    """Sets fields of the whole file; ... removes one."""

    def change(meta):
        for key, value in changes.items():
            if value is ...:
                del meta[key]
            else:
                meta[key] = value

    return change


def pose(how):
    """Changes the fourth pose."""

    def change(meta):
        matrix = np.array(meta["frames"][3]["transform_matrix"])
        meta["frames"][3]["transform_matrix"] = np.array(how(matrix)).tolist()

    return change


def places(how):
    """Changes the places of all cameras."""

    def change(meta):
        for f in meta["frames"]:
            matrix = np.array(f["transform_matrix"])
            matrix[:3, 3] = how(matrix[:3, 3])
            f["transform_matrix"] = matrix.tolist()

    return change


def moved(*offset):
    return lambda place: place + np.array(offset)


def rounded(meta):
    for f in meta["frames"]:
        f["transform_matrix"] = np.round(f["transform_matrix"], 3).tolist()


def set_last_row(matrix):
    matrix[3] = [0, 0, 1, 1]
    return matrix


def set_place(*place):
    def how(matrix):
        matrix[:3, 3] = place
        return matrix

    return how


REFUSED = {
    # Frames
    "no pose": (frame(transform_matrix=...), [NAME, "has no transform_matrix", "remove the frame"]),
    "no file": (frame(file_path=...), ["number 4", "has no file_path"]),
    "file is a number": (frame(file_path=7), ["file_path", "number 4", "is 7"]),
    "file is null": (frame(file_path=None), ["file_path", "number 4", "None"]),
    "file is empty": (frame(file_path=" "), ["file_path", "number 4"]),
    "file is a list": (frame(file_path=["a.png"]), ["file_path", "number 4"]),
    "file has half a character": (frame(file_path="images/\ud800.png"), ["file_path", "number 4", "ud800"]),
    "file is named in Latin-1": (frame(file_path="b\udcfcro.png"), ["file_path", "number 4", "udcfc", "UTF-8"]),
    "back slashes": (frame(file_path=r"images\none.png"), [r"images\none.png", "write / instead"]),
    "mask is null": (frame(mask_path=None), ["mask_path", "number 4"]),
    "one depth alone": (frame(depth_file_path="a.png"), ["has no depth_file_path and others have one"]),
    # Poses
    "pose with NaN": (pose(lambda m: m * [1, NAN, 1, 1]), [NAME, "4 x 4 matrix of finite numbers"]),
    "pose with infinity": (pose(set_place(INF, 0, 0)), [NAME, "4 x 4 matrix of finite numbers"]),
    "pose 2 x 2": (frame(transform_matrix=[[1, 2], [3, 4]]), [NAME, "4 x 4"]),
    "pose 3 x 4": (pose(lambda m: m[:3]), [NAME, "4 x 4"]),
    "pose is text": (frame(transform_matrix="none"), [NAME, "4 x 4"]),
    "pose of texts": (frame(transform_matrix=[["1"] * 4] * 4), [NAME, "4 x 4"]),
    "pose is null": (frame(transform_matrix=None), [NAME, "4 x 4"]),
    "pose with a long number": (frame(transform_matrix=[[10**400, 0, 0, 0]] * 4), [NAME, "4 x 4"]),
    "pose is singular": (pose(lambda m: m * [0, 1, 1, 1]), [NAME, "no rotation and translation"]),
    "pose is zero": (pose(lambda m: m * 0), [NAME, "no rotation and translation"]),
    "pose is scaled": (pose(lambda m: m * [2, 2, 2, 1]), [NAME, "no rotation and translation", "2, 2, 2"]),
    "pose is sheared": (pose(lambda m: m + [[0, 0.3, 0, 0]] * 4), [NAME, "no rotation and translation"]),
    "pose is mirrored": (pose(lambda m: m * [-1, 1, 1, 1]), [NAME, "mirrored"]),
    "pose is transposed": (pose(lambda m: m.T), [NAME, "transposed"]),
    "pose with another last row": (pose(set_last_row), [NAME, "last row"]),
    # Places
    "one camera at 1e9": (pose(set_place(1e9, 0, 0)), [NAME, "stands 1e+09 from the others"]),
    "one camera at 1e5": (pose(set_place(0, 1e5, 0)), [NAME, "from the others"]),
    "all in one place": (places(lambda p: p * 0 + 3), ["stand in one place", "--auto-scale-poses False"]),
    # Intrinsics
    **{f"{k} missing": (file(**{k: ...}), [f"has no {k}"]) for k in ("fl_x", "fl_y", "cx", "cy", "w", "h")},
    **{f"{k} is null": (file(**{k: None}), [f"{k} of", "None"]) for k in ("fl_x", "fl_y", "cx", "cy", "w", "h")},
    **{f"{k} is text": (file(**{k: "28"}), [f"{k} of", "'28'"]) for k in ("fl_x", "cy", "w", "h")},
    **{f"{k} is NaN": (file(**{k: NAN}), [f"{k} of", "nan"]) for k in ("fl_y", "cx", "w", "h")},
    **{f"{k} is negative": (file(**{k: -28}), [f"{k} of", "-28"]) for k in ("fl_x", "cx", "w", "h")},
    **{f"{k} is 0": (file(**{k: 0}), [f"{k} of"]) for k in ("fl_x", "fl_y", "w", "h")},
    "w is not whole": (file(w=32.5), ["w of", "whole pixels"]),
    "w is huge": (file(w=10**9), ["w of", "65536"]),
    "a panorama of two turns": (
        file(camera_model="EQUIRECTANGULAR", fl_x=0.2 * WIDTH, fl_y=HEIGHT),
        ["focal length fl_x", "between 0.5 and"],
    ),
    "focal length 1e12": (file(fl_x=1e12), ["focal length fl_x", "1e+12"]),
    "focal length 1e-9": (file(fl_y=1e-9), ["focal length fl_y", "1e-09"]),
    "cx outside the image": (file(cx=960), ["principal point cx", "960", "outside the image of 32"]),
    "cy outside the image": (file(cy=25), ["principal point cy", "outside the image of 24"]),
    # Lenses
    "unknown camera model": (file(camera_model="PINHOLE2"), ["camera_model", "'PINHOLE2'", "OPENCV_FISHEYE"]),
    "stereo camera model": (file(camera_model="VR180_L"), ["camera_model", "'VR180_L'", "OPENCV_FISHEYE"]),
    "FISHEYE624 without a lens": (file(camera_model="FISHEYE624"), ["distortion_params", "12 numbers"]),
    "a camera model of one frame": (frame(camera_model="OPENCV_FISHEYE"), [NAME, "'OPENCV_FISHEYE'", "state it there"]),
    "fisheye of instant-ngp": (file(is_fisheye=True), ["instant-ngp-data", "OPENCV_FISHEYE"]),
    "an angle of instant-ngp": (file(fl_x=..., camera_angle_x=1.0), ["camera_angle_x", "no fl_x", "instant-ngp-data"]),
    "camera model is null": (file(camera_model=None), ["camera_model", "None"]),
    "k1 is NaN": (file(k1=NAN), ["distortion k1", "nan"]),
    "k2 is null": (file(k2=None), ["distortion k2", "None"]),
    "k1 is text": (file(k1="0.1"), ["distortion k1", "'0.1'"]),
    "p1 is infinite": (file(p1=INF), ["distortion p1", "inf"]),
    "p2 is huge": (file(p2=1e6), ["distortion p2"]),
    "k1 is huge": (file(k1=1e6), ["distortion", "cannot be undone"]),
    "k1 is far below 0": (file(k1=-50), ["distortion", "cannot be undone"]),
    "k3 is far below 0": (file(k3=-1e5), ["distortion", "cannot be undone"]),
    "fisheye folds": (file(camera_model="OPENCV_FISHEYE", k1=-9), ["distortion", "cannot be undone"]),
    "distortion_params of three": (file(distortion_params=[0, 0, 0]), ["distortion_params", "6 numbers"]),
    "a frame's k1 is NaN": (frame(k1=NAN), ["distortion k1", NAME]),
    # Fields of the whole file
    "applied_transform is text": (file(applied_transform="none"), ["applied_transform", "3 rows of 4"]),
    "applied_transform 2 x 2": (file(applied_transform=[[1, 0], [0, 1]]), ["applied_transform", "3 rows of 4"]),
    "applied_transform with NaN": (file(applied_transform=[[NAN] * 4] * 3), ["applied_transform", "Row 1"]),
    "applied_transform 4 x 4": (file(applied_transform=np.eye(4).tolist()), ["applied_transform", "3 rows of 4"]),
    "applied_transform is zero": (file(applied_transform=[[0] * 4] * 3), ["applied_transform", "singular"]),
    "fisheye radius is text": (file(fisheye_crop_radius="a"), ["fisheye_crop_radius", "'a'"]),
    "fisheye radius is 0": (file(fisheye_crop_radius=0), ["fisheye_crop_radius"]),
    "applied_scale is text": (file(applied_scale="2"), ["applied_scale", "'2'"]),
    "applied_scale is 0": (file(applied_scale=0), ["applied_scale", "above 0"]),
    "orientation is unknown": (file(orientation_override="left"), ["orientation_override", "'left'"]),
    # Splits
    "a point cloud that is a number": (file(ply_file_path=3), ["ply_file_path", "3"]),
    "train list with a stranger": (lambda m: m["train_filenames"].append("images/no.png"), ["no.png", "no frame"]),
    "val list is no list": (file(val_filenames="images/a.png"), ["val_filenames", "unusable"]),
    "train list of numbers": (file(train_filenames=[1, 2]), ["train_filenames", "unusable"]),
    "train list is empty": (file(train_filenames=[]), ["train_filenames"]),
    "val list is missing": (file(val_filenames=...), ["no list val_filenames"]),
    "test list is missing": (file(test_filenames=...), ["no list test_filenames"]),
    "test list is empty": (file(test_filenames=[]), ["unusable test_filenames"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_capture_that_cannot_be_used_is_refused(data, edit, tmp_path, case):
    change, words = REFUSED[case]
    edit(change)
    said = train(data, tmp_path).sentence
    assert str(data / "transforms.json") in said
    assert all(word in said for word in words), said


CLOUDS = {
    "no PLY": b"solid cube", "empty": b"", "cut short": b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n"
    b"property float x\nproperty float y\nproperty float z\nend_header\n123",
    "of too many": b"ply\nformat ascii 1.0\nelement vertex 1000000000000000\nproperty float x\nend_header\n1\n",
    "without z": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n",
}  # fmt: skip


@pytest.mark.parametrize("case", CLOUDS)
def test_a_point_cloud_that_cannot_be_read_is_named_and_training_goes_on(data, edit, tmp_path, case):
    (data / "cloud.ply").write_bytes(CLOUDS[case])
    edit(file(ply_file_path="cloud.ply"))
    shown = train(data, tmp_path).shown
    assert "is not a PLY file of points" in shown and "Training goes on without the point cloud" in shown
    assert str(data / "cloud.ply") in shown and "Training finished" in shown


def test_a_capture_without_training_images_is_refused(data, edit, tmp_path):
    edit(lambda meta: [meta.pop(f"{split}_filenames") for split in ("train", "val", "test")])
    options = {"eval_mode": "interval", "eval_interval": 1}
    said = train(data, tmp_path, **{f"pipeline__datamanager__dataparser__{k}": v for k, v in options.items()}).sentence
    assert "holds no training image" in said


TEXTS = {
    "empty": "", "cut short": '{"frames": [', "a list": "[1, 2]", "no frames": "{}", "frames empty": '{"frames": []}',
    "frames of numbers": '{"frames": [3]}', "frames null": '{"frames": null}', "deep": "[" * 100_000,
    "a long number": '{"frames": ' + "1" * 5000 + "}",
}  # fmt: skip


@pytest.mark.parametrize("case", TEXTS)
def test_transforms_that_hold_no_frames_are_refused(data, tmp_path, case):
    (data / "transforms.json").write_text(TEXTS[case])
    assert str(data / "transforms.json") in train(data, tmp_path).sentence


def test_a_folder_without_transforms_is_named_with_what_to_do(tmp_path):
    said = train(tmp_path / "nowhere", tmp_path).sentence
    assert "There is no" in said and "mmpi-prepare" in said and "colmap" in said


def test_a_folder_without_transforms_is_told_the_parser_that_fits(data, tmp_path):
    (data / "transforms.json").rename(data / "transforms_train.json")
    assert "--data FOLDER blender-data)" in train(data, tmp_path).sentence
    (data / "transforms_train.json").unlink()
    assert "--data FOLDER colmap)" in train(data, tmp_path).sentence
    (data / "colmap/sparse").rename(data / "sparse")
    assert "--data FOLDER colmap --colmap-path sparse/0)" in train(data, tmp_path).sentence


RUNS = {
    "tiny coordinates": places(lambda p: p * 1e-9),
    "large coordinates": places(lambda p: p * 1e6),
    "some way off": places(moved(100, -50, 3)),
    "no camera model": file(camera_model=...),
    "pixels as 32.0": file(w=32.0, h=24.0),
    "poses rounded to three digits": rounded,
    "a mild lens": file(k1=-0.1, k2=0.02, p1=1e-3),
    "a fisheye": file(camera_model="OPENCV_FISHEYE", k1=0.01),
    "a whole sphere": file(camera_model="EQUIRECTANGULAR"),
    "FISHEYE624": file(camera_model="FISHEYE624", distortion_params=[0.01, *[0.0] * 11]),
    "parallel rays": file(camera_model="ORTHOPHOTO"),
    "an unknown field": file(aabb_scale=16),
    "no applied_transform": file(applied_transform=...),
}  # fmt: skip


@pytest.mark.parametrize("case", RUNS)
def test_a_capture_that_is_odd_and_usable_trains(data, edit, tmp_path, case):
    edit(RUNS[case])
    assert "Training finished" in train(data, tmp_path).shown


def test_test_images_that_are_trained_on_are_told(data, edit, tmp_path):
    edit(lambda meta: meta["train_filenames"].append(meta["test_filenames"][0]))
    assert "1 of 2 test images are training images too: scores say little" in train(data, tmp_path).shown


# mmpi-plan -----------------------------------------------------------------------------------------------------------


def test_a_folder_that_is_no_scene_is_one_sentence(tmp_path):
    (tmp_path / "data").mkdir()
    said = run("mmpi-plan", tmp_path / "data", "--output", tmp_path / "plan").sentence
    assert "neither a transforms.json nor a COLMAP model" in said


JUDGED = ("pose is singular", "k1 is huge", "val list is missing", "w is text")


@pytest.mark.parametrize("case", JUDGED)
def test_mmpi_plan_refuses_what_ns_train_refuses(data, edit, tmp_path, case):
    change, words = REFUSED[case]
    edit(change)
    said = run("mmpi-plan", data, "--output", tmp_path / "plan").sentence
    assert all(word in said for word in words), said
