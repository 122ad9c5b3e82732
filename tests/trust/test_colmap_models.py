"""COLMAP models that were cut short or do not fit: one sentence from ns-train, in little memory."""

from __future__ import annotations

import struct

import pytest
from forked import train


@pytest.fixture
def model(data):
    """The scene's COLMAP model in the binary format."""
    from mmpi_priors.sfm import load_pycolmap

    folder = data / "colmap/sparse/0"
    load_pycolmap().Reconstruction(str(folder)).write_binary(str(folder))
    for path in folder.glob("*.txt"):
        path.unlink()
    return folder


def cut(name, share):
    def change(folder):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: int(len(whole) * share)])

    return change


def overwrite(name, at, form, value):
    def change(folder):
        whole = bytearray((folder / name).read_bytes())
        struct.pack_into(form, whole, at, value)
        (folder / name).write_bytes(whole)

    return change


MODELS = {
    "points cut short": cut("points3D.bin", 0.6),
    "images cut short": cut("images.bin", 0.6),
    "cameras cut short": cut("cameras.bin", 0.6),
    "too many points": overwrite("points3D.bin", 0, "<Q", 10**12),
    "a camera of no model": overwrite("cameras.bin", 12, "<i", 77),
    "an image of no camera": overwrite("images.bin", 8 + 4 + 56, "<I", 9),
}


def test_a_whole_binary_model_trains(data, model, tmp_path):
    said = train(data, tmp_path).printed
    assert "Training finished" in said and "No SfM tracks" not in said


@pytest.mark.parametrize("case", MODELS)
def test_a_damaged_colmap_model_is_named(data, model, tmp_path, case):
    MODELS[case](model)
    said = train(data, tmp_path, memory=2 << 30).sentence
    assert f"The COLMAP model in {model} cannot be read" in said and "repair or remove it" in said


def test_a_colmap_model_of_text_that_was_cut_short_is_named(data, tmp_path):
    cut("points3D.txt", 0.4)(data / "colmap/sparse/0")
    assert "The COLMAP model in" in train(data, tmp_path, memory=2 << 30).sentence
