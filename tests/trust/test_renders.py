"""ns-render of runs: what it cannot show is said before it begins, and what it can comes out (docs/errors.md)."""

from __future__ import annotations

import os

import numpy as np
import pytest
from forked import start, train
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
    words = ("--load-config", trained / "config.yml", "--output-path", tmp_path / "shown", *options)
    return start("ns-render", what, *words, environment={"PATH": f"{tmp_path}:{os.environ['PATH']}"}).end()


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
