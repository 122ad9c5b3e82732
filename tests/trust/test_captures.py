"""Captures that cannot be used: ns-train ends with one sentence that names file, frame and remedy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from forked import run, train
from tiny_scene import name_of

NAN, INF = math.nan, math.inf
NAME = name_of(3)


def file(frame=None, **changes):
    """Sets fields of the whole file, or of one of its frames; ... removes one."""

    def change(meta):
        target = meta if frame is None else meta["frames"][frame]
        for key, value in changes.items():
            if value is ...:
                del target[key]
            else:
                target[key] = value

    return change


def frame(**changes):
    return file(frame=3, **changes)


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


def set_place(*place):
    def how(matrix):
        matrix[:3, 3] = place
        return matrix

    return how


REFUSED = {
    # Frames
    "no pose": (frame(transform_matrix=...), [NAME, "has no transform_matrix", "remove the frame"]),
    "no file": (frame(file_path=...), ["number 4", "has no file_path"]),
    "file is empty": (frame(file_path=" "), ["file_path", "number 4"]),
    # Poses
    "pose with NaN": (pose(lambda m: m * [1, NAN, 1, 1]), [NAME, "4 x 4 matrix of finite numbers"]),
    "pose 2 x 2": (frame(transform_matrix=[[1, 2], [3, 4]]), [NAME, "4 x 4"]),
    "pose is singular": (pose(lambda m: m * [0, 1, 1, 1]), [NAME, "no rotation and translation"]),
    "pose is scaled": (pose(lambda m: m * [2, 2, 2, 1]), [NAME, "no rotation and translation", "2, 2, 2"]),
    "pose is mirrored": (pose(lambda m: m * [-1, 1, 1, 1]), [NAME, "mirrored"]),
    # Places
    "one camera at 1e9": (pose(set_place(1e9, 0, 0)), [NAME, "stands 1e+09 from the others"]),
    "all in one place": (places(lambda p: p * 0 + 3), ["stand in one place", "--auto-scale-poses False"]),
    # Intrinsics
    "fl_x missing": (file(fl_x=...), ["has no fl_x"]),
    "cx is null": (file(cx=None), ["cx of", "None"]),
    "w is text": (file(w="28"), ["w of", "'28'"]),
    "fl_y is NaN": (file(fl_y=NAN), ["fl_y of", "nan"]),
    "h is negative": (file(h=-28), ["h of", "-28"]),
    "w is not whole": (file(w=32.5), ["w of", "whole pixels"]),
    "focal length 1e12": (file(fl_x=1e12), ["focal length fl_x", "1e+12"]),
    "cx outside the image": (file(cx=960), ["principal point cx", "960", "outside the image of 32"]),
    # Lenses
    "unknown camera model": (file(camera_model="PINHOLE2"), ["camera_model", "'PINHOLE2'", "OPENCV_FISHEYE"]),
    "a camera of renderings": (file(camera_model="VR180_L"), ["camera_model", "'VR180_L'", "OPENCV_FISHEYE"]),
    "fisheye of instant-ngp": (file(is_fisheye=True), ["instant-ngp-data", "OPENCV_FISHEYE"]),
    "k1 is NaN": (file(k1=NAN), ["distortion k1", "nan"]),
    "k1 is huge": (file(k1=1e6), ["distortion", "cannot be undone"]),
    "a barrel too small for its image": (file(k1=-1.96), ["distortion", "cannot be undone"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_capture_that_cannot_be_used_is_refused(data, edit, tmp_path, case):
    change, words = REFUSED[case]
    edit(change)
    said = train(data, tmp_path).sentence
    assert str(data / "transforms.json") in said
    assert all(word in said for word in words), said


CLOUDS = {
    "no PLY": b"solid cube",
    "of too many": b"ply\nformat ascii 1.0\nelement vertex 1000000000000000\nproperty float x\nend_header\n1\n",
}


@pytest.mark.parametrize("case", CLOUDS)
def test_a_point_cloud_that_cannot_be_read_is_named_and_training_goes_on(data, edit, tmp_path, case):
    (data / "cloud.ply").write_bytes(CLOUDS[case])
    edit(file(ply_file_path="cloud.ply"))
    printed = train(data, tmp_path).printed
    assert "is not a PLY file of points" in printed and "Training goes on without the point cloud" in printed
    assert str(data / "cloud.ply") in printed and "Training finished" in printed


def test_a_capture_without_training_images_is_refused(data, edit, tmp_path):
    edit(lambda meta: [meta.pop(f"{split}_filenames") for split in ("train", "val", "test")])
    options = {"eval_mode": "interval", "eval_interval": 1}
    said = train(data, tmp_path, **{f"pipeline__datamanager__dataparser__{k}": v for k, v in options.items()}).sentence
    assert "holds no training image" in said


TEXTS = {"cut short": '{"frames": [', "a list": "[1, 2]", "frames empty": '{"frames": []}', "deep": "[" * 100_000}


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
    "large coordinates": places(lambda p: p * 1e6),
    "no camera model": file(camera_model=...),
    "a fisheye": file(camera_model="OPENCV_FISHEYE", k1=0.01),
    "a whole sphere": file(camera_model="EQUIRECTANGULAR"),
    "FISHEYE624": file(camera_model="FISHEYE624", distortion_params=[0.01, *[0.0] * 11]),
}  # fmt: skip


@pytest.mark.parametrize("case", RUNS)
def test_a_capture_that_is_odd_and_usable_trains(data, edit, tmp_path, case):
    edit(RUNS[case])
    assert "Training finished" in train(data, tmp_path).printed


def test_a_fisheye_whose_borders_are_black_is_told_to_need_masks(data, edit, tmp_path):
    edit(file(camera_model="OPENCV_FISHEYE", fisheye_crop_radius=10.0))
    assert "The fisheye_crop_radius" in (said := train(data, tmp_path).printed) and "mask what lies outside it" in said


def test_test_images_that_are_trained_on_are_told(data, edit, tmp_path):
    edit(lambda meta: meta["train_filenames"].append(meta["test_filenames"][0]))
    assert "1 of 2 test images are training images too: scores say little" in train(data, tmp_path).printed


# mmpi-plan -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", ["pose is singular", "w is text"])
def test_mmpi_plan_refuses_what_ns_train_refuses(data, edit, tmp_path, case):
    change, words = REFUSED[case]
    edit(change)
    said = run("mmpi-plan", data, "--output", tmp_path / "plan").sentence
    assert all(word in said for word in words), said
