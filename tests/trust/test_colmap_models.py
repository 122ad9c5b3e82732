"""COLMAP models that were cut short or do not fit: one sentence from ns-train, in little memory (docs/errors.md)."""

from __future__ import annotations

import struct

import pytest
from forked import run, train


@pytest.fixture
def model(data):
    """The scene's COLMAP model in the binary format."""
    from mmpi_ns.capture.sfm import load_pycolmap

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


def first_number(name, number):
    def change(folder):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(struct.pack("<Q", number) + whole[8:])

    return change


def overwrite(name, at, form, value):
    def change(folder):
        whole = bytearray((folder / name).read_bytes())
        struct.pack_into(form, whole, at, value)
        (folder / name).write_bytes(whole)

    return change


MODELS = {
    "points cut short": cut("points3D.bin", 0.6),
    "points of 20 bytes": cut("points3D.bin", 0.006),
    "points empty": cut("points3D.bin", 0),
    "images cut short": cut("images.bin", 0.6),
    "images cut within a name": cut("images.bin", 0.012),
    "images empty": cut("images.bin", 0),
    "cameras cut short": cut("cameras.bin", 0.6),
    "cameras empty": cut("cameras.bin", 0),
    "too many points": first_number("points3D.bin", 10**12),
    "too many images": first_number("images.bin", 2**63),
    "fewer points than there are": first_number("points3D.bin", 3),
    "a camera of no model": overwrite("cameras.bin", 12, "<i", 77),
    "an image of no camera": overwrite("images.bin", 8 + 4 + 56, "<I", 9),
}


def test_a_whole_binary_model_trains(data, model, tmp_path):
    said = train(data, tmp_path).shown
    assert "Training finished" in said and "No SfM tracks" not in said


@pytest.mark.parametrize("case", MODELS)
def test_a_damaged_colmap_model_is_named(data, model, tmp_path, case):
    MODELS[case](model)
    said = train(data, tmp_path, memory=2 << 30).sentence
    assert f"The COLMAP model in {model} cannot be read" in said and "repair or remove it" in said


@pytest.mark.parametrize("name", ["images.txt", "points3D.txt", "cameras.txt"])
def test_a_colmap_model_of_text_that_was_cut_short_is_named(data, tmp_path, name):
    cut(name, 0.4)(data / "colmap/sparse/0")
    assert "The COLMAP model in" in train(data, tmp_path, memory=2 << 30).sentence


@pytest.mark.parametrize("cut_to", [0.4, None])
def test_the_colmap_parser_names_a_model_that_is_missing_or_cut_short(data, tmp_path, cut_to):
    folder = data / "colmap/sparse/0"
    if cut_to is None:
        folder.rename(tmp_path / "elsewhere")
    else:
        cut("images.txt", cut_to)(folder)
    options = ("--output-dir", tmp_path, "--machine.device-type", "cpu", "--vis", "tensorboard")
    said = run("ns-train", "mmpi-small", "--data", data, *options, "colmap").sentence
    assert f"COLMAP model {'in' if cut_to else 'at'} {folder}" in said
