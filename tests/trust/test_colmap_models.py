"""COLMAP models that were cut short or do not fit: one sentence from ns-train, in little memory (docs/errors.md)."""

from __future__ import annotations

import os
import shutil
import signal
import struct

import pytest
from forked import call, run, train
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from tiny_scene import WIDTH
from training_runs import datamanager


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


def train_colmap(data, tmp_path, *parser):
    options = ("--output-dir", tmp_path, "--machine.device-type", "cpu", "--vis", "tensorboard")
    return run("ns-train", "mmpi-small", "--data", data, *options, "colmap", *parser)


@pytest.mark.parametrize("cut_to", [0.4, None])
def test_the_colmap_parser_names_a_model_that_is_missing_or_cut_short(data, tmp_path, cut_to):
    folder = data / "colmap/sparse/0"
    if cut_to is None:
        folder.rename(tmp_path / "elsewhere")
    else:
        cut("images.txt", cut_to)(folder)
    said = train_colmap(data, tmp_path).sentence
    assert f"COLMAP model {'in' if cut_to else 'at'} {folder}" in said


def test_the_colmap_parser_says_where_a_model_is(data, tmp_path):
    (data / "colmap/sparse").rename(data / "sparse")
    assert train_colmap(data, tmp_path).sentence.endswith("--colmap-path after colmap (sparse/0 holds one).")


def test_the_colmap_parser_without_copies_asks_nobody(data, tmp_path):
    said = train_colmap(data, tmp_path, "--downscale-factor", 2).sentence
    assert f"no copies of {data / 'images'} at 1/2" in said and "there are no copies; 1 takes" in said


def test_the_colmap_parser_names_a_lens_that_it_cannot_use(data, tmp_path):
    file = data / "colmap/sparse/0/cameras.txt"
    _, _, *numbers = file.read_text().split()
    file.write_text(" ".join(["1", "FOV", *numbers, "0.5"]) + "\n")
    said = train_colmap(data, tmp_path).sentence
    assert f"The lens of {file.parent} cannot be used (FOV camera model" in said and "image_undistorter" in said


def test_a_colmap_model_of_one_place_is_refused(data, tmp_path):
    file = data / "colmap/sparse/0/images.txt"
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:2]))
    assert "All 1 camera(s) of" in train_colmap(data, tmp_path).sentence


def test_a_run_of_the_colmap_parser_can_be_rendered_without_its_images(data):
    shutil.rmtree(data / "images")
    settings = {"colmap_path": "colmap/sparse/0", "downscale_factor": 2}
    manager = datamanager(data, test_mode="inference", dataparser=ColmapDataParserConfig(**settings))
    assert int(manager.train_dataset.cameras.width[0]) == WIDTH // 2


def end_by(number):
    from mmpi_priors.sfm import load_pycolmap

    load_pycolmap()
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGABRT])
def test_what_ends_colmap_leaves_no_stack_trace(number):
    """glog, which pycolmap loads, prints one: COLMAP itself ends by SIGABRT where the disk is full."""
    ended = call(end_by, number)
    assert ended.status == -number and "stack trace" not in ended.error
