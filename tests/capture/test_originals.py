"""Which file an image was made from, and its camera there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mmpi_ns.capture.tracks import PosedImages, at_full_size, original_of


def write(path: Path, width: int, height: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (width, height)).save(path)
    return path


def posed(file: Path, width: int, height: int) -> PosedImages:
    pose = np.eye(4)[None, :3]
    intrinsics = np.array([[180.5, 181.5, 152.25, 43.5]])
    return PosedImages((file,), pose, intrinsics, np.array([[float(width), height]]), np.zeros((1, 4)))


def test_a_copy_stands_for_its_original_with_the_focal_length_that_the_parser_divided(tmp_path):
    original = write(tmp_path / "images/a/x.png", 1242, 375)
    copy = write(tmp_path / "images_4/a/x.png", 310, 93)  # rounded down: the scale of its pixels is not 4
    assert original_of(copy) == (original, 4)
    found = at_full_size(posed(copy, 310, 93))
    assert found.files == (original,) and found.sizes.tolist() == [[1242, 375]]
    assert found.intrinsics.tolist() == [[722, 726, 609, 174]]


def test_an_image_without_an_original_is_its_own(tmp_path):
    lone = write(tmp_path / "images_4/x.png", 310, 93)
    for file in (lone, write(tmp_path / "other/x.png", 310, 93)):
        found = at_full_size(posed(file, 310, 93))
        assert found.files == (file,) and found.sizes.tolist() == [[310, 93]]
        assert found.intrinsics.tolist() == [[180.5, 181.5, 152.25, 43.5]]


def test_a_file_of_that_name_but_of_another_shape_is_no_original(tmp_path):
    write(tmp_path / "images/x.png", 1242, 700)
    copy = write(tmp_path / "images_4/x.png", 310, 93)
    assert at_full_size(posed(copy, 310, 93)).files == (copy,)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"x\.png cannot be read"):
        at_full_size(posed(tmp_path / "x.png", 4, 4))
