"""ns-render and mmpi-export of runs: what cannot be shown is said before it begins, and what can comes out."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest
from forked import run, start, train
from PIL import Image
from tiny_scene import HEIGHT, TEST, WIDTH, name_of, write_scene


@pytest.fixture(scope="module")
def trained(whole_scene, tmp_path_factory):
    """The folder of a finished run."""
    output = tmp_path_factory.mktemp("trained")
    assert train(whole_scene, output).status == 0
    return output / "tiny/mmpi-small/run"


RGBA = ("--rendered-output-names", "rgb", "rgba")


def render(trained, tmp_path, what, *options):
    """ns-render, where something is called ffmpeg, which images need for a check alone."""
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    shown = tmp_path / ("shown.mp4" if what == "camera-path" else "shown")
    words = ("--load-config", trained / "config.yml", "--output-path", shown, *options)
    return start("ns-render", what, *words, environment={"PATH": f"{tmp_path}:{os.environ['PATH']}"}).end()


def test_ns_render_names_the_only_test_image_which_is_no_path(whole_scene, tmp_path):
    data = shutil.copytree(whole_scene, tmp_path / "data")
    meta = json.loads((data / "transforms.json").read_text())
    meta |= {f"{split}_filenames": meta["test_filenames"][:1] for split in ("val", "test")}
    (data / "transforms.json").write_text(json.dumps(meta))
    assert train(data, tmp_path).status == 0
    folder, images = tmp_path / "tiny/mmpi-small/run", ("--output-format", "images", "--interpolation-steps", "2")
    said = render(folder, tmp_path, "interpolate", *images).sentence
    assert name_of(TEST[0]) in said and "--pose-source train" in said
    assert render(folder, tmp_path, "interpolate", *images, "--pose-source", "train").shown


@pytest.mark.parametrize("what", ["dataset", "interpolate"])
def test_ns_render_names_the_format_that_holds_what_is_transparent(trained, tmp_path, what):
    ended = render(trained, tmp_path, what, *RGBA)
    assert "The output rgba is transparent" in ended.sentence and "loading" not in ended.out
    if what == "interpolate":
        png = ("--output-format", "images", "--image-format", "png")
        assert "ask for it alone" in render(trained, tmp_path, what, *png, *RGBA).sentence
        assert render(trained, tmp_path, what, *png, "--rendered-output-names", "rgba").shown
    else:
        assert render(trained, tmp_path, what, "--image-format=png", *RGBA).shown
        assert Image.open(next((tmp_path / "shown/test/rgba").iterdir())).mode == "RGBA"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--frame-rate", "0"), "--frame-rate must be"),
        (("--interpolation-steps=0",), "--interpolation-steps must be"),
        (("--output-format", "video"), "shown says no format"),
        (("--output-format", "images", "--downscale-factor", "500"), "0 x 0 pixels shows nothing"),
    ],
)
def test_ns_render_names_what_cannot_be_rendered(trained, tmp_path, options, words):
    assert words in render(trained, tmp_path, "interpolate", *options).sentence


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read"),
        ("{", "cannot be read"),
        ("{}", "cannot be read"),
        ('{"render_width": 9, "render_height": 9, "seconds": 1, "camera_path": []}', "holds no camera"),
        ('{"render_width": 9, "render_height": 9, "seconds": 0, "camera_path": [1]}', "The seconds of"),
    ],
)
def test_ns_render_names_a_camera_path_that_it_cannot_follow(trained, tmp_path, text, words):
    path = tmp_path / "my_path.json"
    if text is not None:
        path.write_text(text)
    said = render(trained, tmp_path, "camera-path", "--camera-path-filename", path).sentence
    assert str(path) in said and words in said


def test_ns_render_takes_copies_of_a_data_set_by_their_factor(trained, whole_scene, tmp_path):
    half = ("--split", "test", "--downscale-factor", "2")
    assert "1/2 of its size" in render(trained, tmp_path, "dataset", *half).sentence
    data = shutil.copytree(whole_scene, tmp_path / "data")
    (data / "images_2").mkdir()
    for path in (data / "images").iterdir():
        Image.open(path).reduce(2).save(data / "images_2" / path.name)
    assert render(trained, tmp_path, "dataset", "--data", data, *half).shown
    shown = next((tmp_path / "shown/test/rgb").iterdir())
    assert Image.open(shown).size == (WIDTH // 2, HEIGHT // 2)


@pytest.mark.parametrize(("command", "end"), [(("ns-eval",), "a.json"), (("ns-render", "dataset"), "a")])
def test_a_result_that_cannot_be_written_is_told_before_anything_is_loaded(trained, tmp_path, command, end):
    (tmp_path / "file").write_text("")
    config = ("--load-config", trained / "config.yml", "--output-path", tmp_path / "file" / end)
    ended = start(*command, *config).end()
    assert "cannot be written" in ended.sentence and "another --output-path" in ended.sentence
    assert "loading" not in ended.out


@pytest.mark.parametrize("name", ["scores", "scores.txt"])
def test_ns_eval_names_a_result_that_is_no_json(trained, tmp_path, name):
    config = ("--load-config", trained / "config.yml", "--output-path", tmp_path / name)
    ended = start("ns-eval", *config).end()
    assert f"{name} is no .json file" in ended.sentence and "loading" not in ended.out


def test_ns_render_shows_the_nearest_training_image_beside_its_own(trained, tmp_path):
    options = ("--output-format", "images", "--render-nearest-camera", "True", "--interpolation-steps", "1")
    assert render(trained, tmp_path, "interpolate", *options).shown
    assert all(Image.open(path).size == (2 * WIDTH, HEIGHT) for path in (tmp_path / "shown").iterdir())


def test_ns_render_shows_see_through_originals_over_its_background(tmp_path):
    data = write_scene(tmp_path / "data", alpha=True)
    assert train(data, tmp_path).status == 0
    folder = tmp_path / "tiny/mmpi-small/run"
    assert render(folder, tmp_path, "dataset", "--split", "train+test", "--image-format", "png").shown
    shown = np.array(Image.open(tmp_path / "shown/test/gt-rgb" / name_of(TEST[0])))
    stored = np.array(Image.open(data / "images" / name_of(TEST[0])))
    quarter = HEIGHT // 4
    assert np.abs(shown[:quarter].astype(int) - 127.5).max() < 1
    np.testing.assert_array_equal(shown[quarter:], stored[quarter:, :, :3])
    options = ("--output-format", "images", "--render-nearest-camera", "True", "--interpolation-steps", "1")
    assert render(folder, tmp_path, "interpolate", *options).shown


def test_an_export_that_was_interrupted_is_begun_anew(trained, tmp_path):
    command = ("mmpi-export", "web", "--load-config", trained / "config.yml", "--output", tmp_path / "site")
    assert "Wrote" in run(*command).shown
    whole = {path.name: path.read_bytes() for path in (tmp_path / "site").iterdir()}
    (tmp_path / "site/scene.json").unlink()
    for name in ("window-00001.bin", ".window-00001.bin.77.tmp", ".scene.json.77.tmp"):
        (tmp_path / "site" / name).write_bytes(b"half")
    assert "Wrote" in run(*command).shown
    assert {path.name: path.read_bytes() for path in (tmp_path / "site").iterdir()} == whole
