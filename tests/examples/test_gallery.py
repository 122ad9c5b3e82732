"""The gallery's page: what a trained scene's row says, and where its pictures lie."""

from __future__ import annotations

import json
import os

import film
import pytest
from demo import Demo
from gallery import SHOWN, Gallery
from PIL import Image


@pytest.fixture
def learned(plan, monkeypatch):
    """Scenes are learned at once: a plan, a checkpoint that took 12 s, a picture and a film of three frames."""

    def learn(demo: Demo):
        demo.checkpoint.parent.mkdir(parents=True)
        demo.scene.mkdir()
        scene = {"w": 32, "h": 24, "train_filenames": ["a", "b", "c"]}
        (demo.scene / "transforms.json").write_text(json.dumps(scene))
        (demo.run / "plan.json").write_text(plan.to_json())
        (demo.folder / "times.json").write_text('{"started": 1000.0}')
        demo.checkpoint.touch()
        os.utime(demo.checkpoint, (1012, 1012))
        Image.new("RGB", (64, 40), (200, 10, 10)).save(demo.folder / "overview.png")
        stills = [Image.new("RGB", (64, 48), (80 * i, 0, 0)) for i in range(3)]
        return {"psnr": 20.123, "ssim": 0.6543}, film.write_film(stills, demo.folder)

    monkeypatch.setattr(Demo, "learn", learn)


@pytest.mark.usefixtures("learned")
def test_the_page_has_a_row_a_picture_and_a_clip_of_every_scene(tmp_path, plan):
    (tmp_path / "docs").mkdir()
    Gallery(tmp_path / "runs", tmp_path / "docs").main()
    text = (tmp_path / "docs" / "gallery.md").read_text()
    mpis, texels = len(plan.mpis), plan.texels / 1e6
    assert f"| [street](#street) | 3 | 32 x 24 | 1000 | {mpis} | {texels:.1f} | 12 s | 20.12 | 0.654 |" in text
    for name in SHOWN:
        for ending, frames in (("jpg", 1), ("webp", 3)):
            assert f"(images/gallery/{name}.{ending})" in text
            with Image.open(tmp_path / "docs" / "images" / "gallery" / f"{name}.{ending}") as picture:
                assert getattr(picture, "n_frames", 1) == frames


def test_a_scene_that_is_not_shown_is_named(tmp_path):
    with pytest.raises(ValueError, match="no scene 'attic' in the gallery"):
        Gallery(tmp_path, tmp_path, only=("attic",)).main()
