"""Image files that cannot be used, or are of another kind: ns-train names the file and the remedy."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from forked import train
from PIL import Image
from tiny_scene import HEIGHT, WIDTH, name_of


def smooth(channels):
    return np.broadcast_to(np.linspace(0, 255, WIDTH)[None, :, None], (HEIGHT, WIDTH, channels)).astype(np.uint8)


ODD = {
    "transparent": lambda: Image.fromarray(smooth(4)),
    "a palette": lambda: Image.fromarray(smooth(3)).convert("P"),
    "16 bits": lambda: Image.fromarray(np.full((HEIGHT, WIDTH), 40_000, np.uint16)),
}


@pytest.mark.parametrize("kind", ODD)
def test_images_of_other_kinds_among_rgb_train(data, tmp_path, kind):
    ODD[kind]().save(data / "images" / name_of(3))
    assert "Training finished" in train(data, tmp_path).printed


DAMAGED = {
    "missing": lambda p: p.unlink(),
    "cut short": lambda p: p.write_bytes(p.read_bytes()[:300]),
    "no image": lambda p: p.write_bytes(b"hello"),
    "of floats": lambda p: Image.fromarray(np.zeros((HEIGHT, WIDTH), np.float32)).save(p, format="TIFF"),
}


@pytest.mark.parametrize("case", DAMAGED)
@pytest.mark.parametrize("i", [3, 5])
def test_an_image_that_cannot_be_read_is_named(data, tmp_path, case, i):
    DAMAGED[case](data / "images" / name_of(i))
    said = train(data, tmp_path).sentence
    assert name_of(i) in said and "cannot be read" in said and "leave it out" in said


def test_an_image_of_another_size_is_named(data, tmp_path):
    shutil.rmtree(data / "colmap")
    Image.new("RGB", (WIDTH + 2, HEIGHT)).save(data / "images" / name_of(3))
    ended = train(data, tmp_path)
    said = ended.sentence
    assert f"{WIDTH + 2} x {HEIGHT} pixels and its camera {WIDTH} x {HEIGHT}" in said and "EXIF" not in said
    assert "matching" not in ended.out  # which takes minutes


ARRAYS = {
    "of three channels": np.zeros((HEIGHT, WIDTH, 3)), "of objects": np.array([{"a": 1}], dtype=object),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["missing", "colours", *ARRAYS])
def test_a_depth_image_that_cannot_be_used_is_named(data, edit, tmp_path, kind):
    (data / "depths").mkdir()
    for i in range(8):
        Image.fromarray(np.full((HEIGHT, WIDTH), 4000, np.uint16)).save(data / "depths" / name_of(i))
    edit(lambda meta: [f.update(depth_file_path=f["file_path"].replace("images", "depths")) for f in meta["frames"]])
    path = data / "depths" / name_of(3)
    path.unlink()
    if kind == "colours":
        Image.fromarray(smooth(3)).save(path)
    if kind in ARRAYS:
        path = path.with_suffix(".npy")
        np.save(path, ARRAYS[kind])
        edit(lambda meta: meta["frames"][3].update(depth_file_path=f"depths/{path.name}"))
    if kind == "missing":
        shutil.rmtree(data / "colmap")
    ended = train(data, tmp_path)
    assert f"Depth image {path}" in ended.sentence
    assert kind != "missing" or "matching" not in ended.out  # which takes minutes


@pytest.mark.parametrize("factor", [8, 0])
def test_downscaling_without_copies_says_which_there_are(data, tmp_path, factor):
    (data / "images_2").mkdir()
    said = train(data, tmp_path, pipeline__datamanager__dataparser__downscale_factor=factor).sentence
    assert "--downscale-factor" in said and (factor < 1 or "images_2" in said)
