"""``mmpi-bench score``: anybody's renderings, matched by name and scored by definition; mistakes are one sentence."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from score import ScoreRow

from mmpi_ns.bench.score import Score
from mmpi_ns.scripts.bench import entrypoint


@pytest.fixture
def tests_of(scene) -> dict[str, np.ndarray]:
    """The test images of the tiny scene, by name."""
    meta = json.loads((scene / "transforms.json").read_text())
    return {Path(n).stem: np.asarray(Image.open(scene / n).convert("RGB")) for n in meta["test_filenames"]}


@pytest.fixture
def rendered(tests_of, tmp_path) -> Path:
    """The test images, one darker by 10 levels and one by 30, and a picture that is nobody's rendering."""
    folder = tmp_path / "renders"
    folder.mkdir()
    for (name, image), off in zip(tests_of.items(), (10, 30), strict=True):
        Image.fromarray(darker(image, off)).save(folder / f"{name}.PNG")
    Image.new("RGB", (3, 3)).save(folder / "thumbnail.png")
    return folder


def darker(image: np.ndarray, levels: int) -> np.ndarray:
    return np.clip(image.astype(int) - levels, 0, 255).astype(np.uint8)


def score(rendered: Path, scene: Path, **settings) -> None:
    Score(images=rendered, data=scene, lpips="none", **settings).main()


def score_row(rendered: Path, scene: Path, **settings) -> None:
    ScoreRow(images=rendered, data=scene, lpips="none", output=rendered.parent / "results", **settings).main()


def test_scores_follow_the_definition_and_a_row_is_kept(rendered, scene, tests_of, capsys):
    score_row(rendered, scene, method="dark", given="poses", seconds=12.0, frame=0.05, memory=1.5)
    score_row(rendered, scene, method="again")
    wanted = []
    for image, off in zip(tests_of.values(), (10, 30), strict=True):
        error = (darker(image, off).astype(np.float64) - image) / 255
        wanted.append(-10 * np.log10((error**2).mean()))
    content = json.loads((rendered.parent / "results" / "score.json").read_text())
    assert [r["method"] for r in content["rows"].values()] == ["dark", "again"]
    row = next(iter(content["rows"].values()))
    assert row["psnr"] == pytest.approx(np.mean(wanted), abs=1e-4) and row["images"] == 2
    assert [v["psnr"] for v in row["each"].values()] == pytest.approx(wanted, abs=1e-4)
    said, text = capsys.readouterr().out, (rendered.parent / "results" / "score.md").read_text()
    assert f"2 images: PSNR {np.mean(wanted):.2f} dB" in said and "torchmetrics" in said
    assert f"| dark | {scene.name} /1 | poses | 12 | 1.5 | 0.05 | 2 | {np.mean(wanted):.2f} |" in text


def test_the_command_writes_nothing(rendered, scene):
    before = set(rendered.parent.rglob("*"))
    score(rendered, scene)
    assert set(rendered.parent.rglob("*")) == before


def test_some_of_the_test_images_are_enough_where_some_are_asked_for(rendered, scene, tests_of):
    (rendered / f"{next(iter(tests_of))}.PNG").unlink()
    score(rendered, scene, test_images=1)  # one of two, evenly spaced, is the second


def resize(folder: Path, name: str) -> None:
    Image.new("RGB", (16, 12)).save(folder / f"{name}.PNG")


def see_through(folder: Path, name: str) -> None:
    Image.new("RGBA", (32, 24), (1, 2, 3, 100)).save(folder / f"{name}.PNG")


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda folder, name: (folder / f"{name}.PNG").unlink(), "lacks 1 of 2 test images"),
        (lambda folder, name: (folder / f"{name}.PNG").write_text("no image"), "cannot be read"),
        (lambda folder, name: Image.new("RGB", (32, 24)).save(folder / f"{name}.jpg"), "keep one of them"),
        (resize, "has 16 x 12 pixels and its test image 32 x 24"),
        (see_through, "is see-through"),
        (lambda folder, name: [p.unlink() for p in folder.iterdir()], "no image is there"),
    ],
)
def test_a_mistake_is_one_sentence(harm, said, rendered, scene, tests_of, monkeypatch, capsys):
    harm(rendered, next(iter(tests_of)))
    words = ["mmpi-bench", "score", "--images", str(rendered), "--data", str(scene), "--lpips", "none"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        entrypoint()
    error = capsys.readouterr().err.strip()
    assert ended.value.code == 1 and said in error and error.startswith("mmpi-bench: ") and "\n" not in error


def test_folders_that_are_not_there_are_named(rendered, scene, tmp_path):
    with pytest.raises(ValueError, match="There is no folder"):
        score(tmp_path / "none", scene)
    with pytest.raises(ValueError, match=r"There is no .*transforms\.json"):
        score(rendered, tmp_path / "none")


def test_a_scene_without_test_images_is_named(rendered, scene, tmp_path):
    meta = json.loads((scene / "transforms.json").read_text())
    meta = {key: value for key, value in meta.items() if not key.endswith("_filenames")}
    (tmp_path / "transforms.json").write_text(json.dumps(meta | {"frames": meta["frames"][:4]}))
    (tmp_path / "images").symlink_to(scene / "images")
    with pytest.raises(ValueError, match="no test images: list them as test_filenames"):
        score(rendered, tmp_path)


def test_the_test_images_themselves_are_not_a_rendering(scene, tests_of, tmp_path):
    for name, image in tests_of.items():
        Image.fromarray(image).save(tmp_path / f"{name}.png")
    with pytest.raises(ValueError, match="the test images themselves"):
        score(tmp_path, scene)
