"""benchmarks/ablate.py: every variant at equal rays and at equal time."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import ablate
import pytest
import trainings
from ablate import Ablate, equal_time_steps
from methods import Method
from suites import ABLATIONS

from mmpi_ns.bench.trainers import JOINT, P, Scene

NAMES = ("reference", "twice as slow", "about as fast")


@pytest.fixture
def three(monkeypatch):
    """A suite whose trainings are pretended."""
    variants = [Method(name, "mmpi-small", (P + "planes", str(i)), group="g") for i, name in enumerate(NAMES)]
    monkeypatch.setitem(ABLATIONS, "drive", variants)
    asked = []

    def pretend(request, threads):
        which, steps = int(request.words[request.words.index(P + "planes") + 1]), request.checks[-1]
        asked.append((NAMES[which], steps))
        pace, quality = [(0.1, 20.0), (0.2, 21.0), (0.101, 19.0)][which]
        row = {"psnr": quality + math.log10(steps / 100), "ssim": 0.5, "rays": 64 * steps}
        return {**row, "setup_seconds": 2.0, "seconds": 2.0 + pace * steps}

    monkeypatch.setattr(ablate, "train_apart", pretend)
    return asked


def command(scene, folder, **changes):
    settings = {"steps": 100, "rays": 64, "threads": 1} | changes
    return Ablate(
        data=scene, downscale_factor=1, suite="drive", output=folder / "results", work=folder / "work", **settings
    )


def read(folder):
    return json.loads((folder / "results" / "ablate-drive.json").read_text())


def test_a_slower_variant_is_run_again_for_the_seconds_of_the_reference(scene, tmp_path, three):
    command(scene, tmp_path).run()
    assert three == [("reference", 100), ("twice as slow", 100), ("twice as slow", 50), ("about as fast", 100)]
    found = read(tmp_path)["headline"]
    assert found["reference_psnr_db"] == 20 and found["twice_as_slow_delta_db"] == 1
    assert found["twice_as_slow_delta_at_equal_time_db"] == pytest.approx(1 + math.log10(0.5))
    assert found["about_as_fast_delta_at_equal_time_db"] == found["about_as_fast_delta_db"] == -1
    assert all(math.isfinite(v) for v in found.values())
    text = (tmp_path / "results" / "ablate-drive.md").read_text()
    assert "| twice as slow | 21.00 | +1.00 | 0.500 | 22 | 50 | 20.70 | +0.70 | 12 |" in text
    command(scene, tmp_path).run()
    assert len(three) == 4, "finished runs are kept"
    command(scene, tmp_path, steps=200, only="about", equal_time=False).run()
    assert three[4:] == [("reference", 200), ("about as fast", 200)]


def test_a_variant_that_fails_is_named_and_tried_again(scene, tmp_path, three, monkeypatch):
    pretend = ablate.train_apart

    def fail(request, threads):
        if "2" in request.words[request.words.index(P + "planes") + 1]:
            return {"not_run": "it failed"}
        return pretend(request, threads)

    monkeypatch.setattr(ablate, "train_apart", fail)
    command(scene, tmp_path).run()
    assert "- about as fast, seed 0: it failed." in (tmp_path / "results" / "ablate-drive.md").read_text()
    assert "about_as_fast_delta_db" not in read(tmp_path)["headline"]
    monkeypatch.setattr(ablate, "train_apart", pretend)
    command(scene, tmp_path).run()
    assert "about_as_fast_delta_db" in read(tmp_path)["headline"]


def test_setting_up_counts_as_time():
    reference = {"seconds": 12.0, "steps": 100, "setup_seconds": 2.0}
    assert equal_time_steps(reference, {"seconds": 26.0, "steps": 100, "setup_seconds": 6.0}) == 30
    assert equal_time_steps(reference, {"seconds": 12.9, "steps": 100, "setup_seconds": 2.0}) == 100


def test_ablate_end_to_end(scene, tmp_path, monkeypatch):
    def here(request, threads):
        return trainings.train(asdict(request), lambda text: None)

    small = (*JOINT, P + "max-planes", "16")
    variants = [
        Method("placed", "mmpi-small", small, group="g"),
        Method("one", "mmpi-small", (*small, P + "max-mpis", "1"), group="g"),
    ]
    monkeypatch.setitem(ABLATIONS, "drive", variants)
    monkeypatch.setattr(ablate, "train_apart", here)
    command(scene, tmp_path, steps=4, equal_time=False, seeds=(0, 1)).run()
    rows = read(tmp_path)["rows"]
    assert len(rows) == 4 and all(r["images"] == 2 and r["rays"] == 4 * 64 for r in rows.values())
    assert len({r["split"]["digest"] for r in rows.values()}) == 1
    assert all(math.isfinite(v) for v in read(tmp_path)["headline"].values())
    assert (tmp_path / "results" / "ablate-drive.png").stat().st_size > 5_000


def test_every_ablation_is_made_of_lines_that_ns_train_takes(scene, tmp_path):
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    for suite, variants in ABLATIONS.items():
        assert len({v.name for v in variants}) == len(variants), suite
        seen = []
        for v in variants:
            words = v.words(Scene(scene, 1), tmp_path, 5, 64, 0, "cpu")
            config = tyro.cli(AnnotatedBaseConfigUnion, args=words)
            seen.append((config.pipeline.model, config.pipeline.datamanager, config.optimizers))
        assert all(a != b for i, a in enumerate(seen) for b in seen[:i]), f"{suite}: two variants are the same"
