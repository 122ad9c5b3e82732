"""The demo's training has options that ns-train takes."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

from mmpi_ns.training.options import check_run

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_options_of_the_demo_can_be_used(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])
    from demo import Demo, DemoError

    commands = []
    monkeypatch.setattr(Demo, "_command", lambda self, *words: commands.append(words))
    (tmp_path / "demo").mkdir()
    with pytest.raises(DemoError, match="ended before its last step"):
        Demo(tmp_path / "demo")._train()
    ((program, *words),) = commands
    config = tyro.cli(AnnotatedBaseConfigUnion, args=words)
    assert program == "ns-train" and config.method_name == "mmpi" and config.max_num_iterations == 1000
    check_run(config)


def test_the_images_held_out_are_counted_in_the_scene(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])
    from demo import Demo

    demo = Demo(tmp_path, kind="room", images=16)
    demo.scene.mkdir()
    (demo.scene / "transforms.json").write_text('{"test_filenames": ["7.png", "15.png"]}')
    demo._say_where({"psnr": 20.0, "ssim": 0.5}, tmp_path / "fly.mp4", 60.0)
    assert "over 2 images held out" in capsys.readouterr().out
