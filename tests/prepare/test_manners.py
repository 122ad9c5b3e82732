"""What mmpi-prepare says and when: options before any work, one sentence at the end, nothing left out in silence."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
import time

import corridor
import numpy as np
import pycolmap
import pytest
from PIL import Image

from mmpi_ns.utils.errors import InputError
from mmpi_prepare import images
from mmpi_prepare.pipeline import WORK, only_one, prepare
from mmpi_prepare.settings import Settings
from mmpi_priors.sfm import quiet

NAN = float("nan")


@pytest.fixture
def frames(tmp_path):
    corridor.write_images(tmp_path / "frames", 3)
    return tmp_path / "frames"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"focal": NAN}, "--focal"), ({"focal": -3.0}, "--focal"), ({"camera_height": 0.0}, "--camera-height"),
        ({"camera": (NAN, 1.0, 1.0)}, "--camera"), ({"camera": (9.0, 1.0, 1.0), "focal": 9.0}, "leave one out"),
        ({"focal": 9.0, "lens": "radial"}, "--lens radial"),
        ({"camera": (9.0, 1.0, 1.0), "lens": "opencv", "refine_intrinsics": True}, "--lens opencv"),
        ({"test_every": 1}, "--test-every"), ({"test_every": -4}, "--test-every"),
        ({"downscales": (2, 0)}, "--downscales"),
        ({"downscales": (2, 2)}, "--downscales"), ({"refine_poses": True}, "--poses"), ({"overlap": 0}, "--overlap"),
        ({"threads": 0}, "--threads"), ({"max_frames": 1}, "--max-frames"),
    ],
)  # fmt: skip
def test_options_are_judged_before_any_work(options, words, frames, tmp_path):
    with pytest.raises(InputError, match=words):
        prepare(Settings(frames, tmp_path / "scene", **options))
    assert not (tmp_path / "scene").exists()


def test_copies_of_no_pixel_are_refused_before_any_work(frames, tmp_path):
    with pytest.raises(InputError, match=r"--downscales 5000 leaves no pixel of frame_00\d.png"):
        prepare(Settings(frames, tmp_path / "scene", downscales=(2, 5000)))
    assert not (tmp_path / "scene/transforms.json").exists()


def test_a_second_run_into_a_scene_says_so_and_ends(frames, tmp_path):
    with only_one(tmp_path / "scene" / WORK), pytest.raises(InputError, match=r"Another mmpi-prepare is making"):
        prepare(Settings(frames, tmp_path / "scene"))
    with only_one(tmp_path / "scene" / WORK):
        pass  # free again


def test_a_scene_that_cannot_be_written_is_one_sentence(tmp_path):
    (tmp_path / "notes.txt").write_text("a file")
    with pytest.raises(InputError, match=r"notes.txt.* cannot be read or written \(Not a directory\): check"):
        with only_one(tmp_path / "notes.txt" / "scene" / WORK):
            pass


def test_what_is_not_read_is_counted_and_named(frames, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for name in ("IMG_1.HEIC", "IMG_2.heic", "clip.mov", "more/other.png", ".hidden"):
        (frames / name).parent.mkdir(exist_ok=True)
        (frames / name).write_bytes(b"")
    assert len(images.find_images(frames)) == 3
    said = capsys.readouterr().out
    assert "2 .heic files are not read: pip install pillow-heif" in said and "IMG_1.HEIC, IMG_2.heic" in said
    assert "1 .mov files are not read (clip.mov)" in said and "1 .png files are in subfolders" in said
    assert "hidden" not in said


def test_a_photo_of_a_telephone_is_read(tmp_path):
    heif = pytest.importorskip("pillow_heif", reason="pillow-heif is an extra: pip install 'mmpi-ns[heic]'")
    heif.register_heif_opener()
    (tmp_path / "in").mkdir()
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 36
    picture = Image.fromarray(corridor.picture(corridor.poses(1)[0]))
    for n in range(2):
        picture.save(tmp_path / "in" / f"IMG_{n}.HEIC", quality=95, exif=exif)
    photos = images.gather(tmp_path / "in", images.find_images(tmp_path / "in"), tmp_path / "out")
    assert [p.name for p in photos] == ["IMG_0.jpg", "IMG_1.jpg"]
    assert photos[0].exif_focal == pytest.approx(corridor.WIDTH)
    copy = np.asarray(Image.open(tmp_path / "out/images/IMG_0.jpg"), float)
    assert np.abs(copy - np.asarray(picture, float)).mean() < 4


def test_the_last_line_is_a_command_to_copy(tmp_path, capsys):
    corridor.write_images(tmp_path / "frames", 8)
    scene = tmp_path / ("a [long] name " * 9).strip()
    prepare(Settings(tmp_path / "frames", scene, focal=corridor.FOCAL, threads=1))
    *_, last = capsys.readouterr().out.splitlines()
    assert shlex.split(last) == ["ns-train", "mmpi", "--data", str(scene)]
    assert (scene / "transforms.json").is_file() and not (scene / WORK).exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_with_one_sentence(number, tmp_path):
    corridor.write_images(tmp_path / "frames", 14)
    command = [sys.executable, "-m", "mmpi_prepare.__main__", str(tmp_path / "frames"), str(tmp_path / "scene")]
    run = subprocess.Popen([*command, "--threads", "1"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "scene" / WORK / "features").is_dir() and run.poll() is None:
        time.sleep(0.05)
    run.send_signal(number)
    _, said = run.communicate(timeout=60)
    assert run.returncode == 128 + number
    assert said.replace("\x1b[?25h", "").strip() == "mmpi-prepare: interrupted; the same command continues from here."
    if number == signal.SIGINT:
        prepare(Settings(tmp_path / "frames", tmp_path / "scene", threads=1))
        assert (tmp_path / "scene" / "transforms.json").is_file()


@pytest.mark.parametrize(
    ("ends", "status", "words"), [("sys.exit(3)", 3, ""), ("os.kill(os.getpid(), 9)", 137, "SIGKILL, perhaps")]
)
def test_the_exit_status_is_that_of_the_work(ends, status, words):
    program = (
        f"from mmpi_prepare.__main__ import end_at_once_on_signals; import os, sys; end_at_once_on_signals(); {ends}"
    )
    ended = subprocess.run([sys.executable, "-c", program], check=False, stderr=subprocess.PIPE, text=True)
    assert ended.returncode == status and (words in ended.stderr if words else not ended.stderr)


def test_errors_of_colmap_are_said_in_words_alone(capfd):
    with quiet():
        pycolmap.logging.error("a line of C++")
    assert "a line of C++" not in capfd.readouterr().err
    pycolmap.logging.error("a line of C++")
    assert "a line of C++" in capfd.readouterr().err
