"""The dense reference that speed is measured against renders the same field."""

from __future__ import annotations

import json
from pathlib import Path

import lab
import numpy as np
import pytest
import results
from all_planes import render_densely
from lab import train_and_evaluate
from PIL import Image
from random_fields import bundle, random_field, random_rays
from suites import DEFAULT, SUITES

from mmpi_ns.bench.trainers import Scene
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.placement.errors import PixelErrors
from mmpi_ns.rendering.rendered import render_rays


def test_the_dense_reference_renders_what_the_sampler_renders():
    field = random_field(3)
    field.features.data.mul_(0.3)
    rays = bundle(*random_rays(field.plan, 64, seed=1))
    ours = render_rays(rays, field, MarchOptions(0.0))
    reference, samples = render_densely(field, rays)
    # The reference leaves out colours below alpha = 1e-4, so they may differ by that much a sample.
    found = ours.rgb + 0.5 * ours.composite.transmittance
    assert samples == 36 and float((found - reference).abs().max()) < 5e-3
    assert float(found.std()) > 0.05


def test_rows_of_a_suite_have_different_names():
    for variants in SUITES.values():
        keys = [(v.group, v.name) for v in variants]
        assert len(set(keys)) == len(keys)


def test_a_row_of_results_says_what_was_run(tmp_path):
    models = tmp_path / "nerfstudio_models"
    models.mkdir()
    for step in (999, 1999, 10):
        (models / f"step-{step:09d}.ckpt").touch()
    assert results.steps_of(tmp_path) == 2000
    suite = SUITES["fox"]
    row = {
        "psnr": 21.237, "ssim": 0.81, "lpips_vgg": 0.4567, "num_rays_per_sec": 1234.5, "train_seconds": 99.6,
        "steps": 2000, "threads": 2, "mpis": 7, "texels": 12_345_678, "e_p_50": 0.1, "e_p_90": 0.2, "e_t_50": 1.5,
        "e_t_90": 2.5, "processor": "2 cores of X", "commit": "abc", "date": "2026-01-02",
    }  # fmt: skip
    rows = {suite[0].key: row}
    made = {k: "" for k in ("command", "processor", "threads", "torch", "commit", "date")}
    lines = results.markdown("fox", {"rows": rows, "made": made}).splitlines()
    (line,) = [x for x in lines if x.startswith(f"| {suite[0].name} |")]
    wanted = [suite[0].name, "21.24", "0.810", "0.457", "2.05 M", "100", "2", "1234", "7", "12.3", "0.10 / 0.20",
              "1.50 / 2.50"]  # fmt: skip
    assert [c.strip() for c in line.strip("|").split("|")] == wanted
    header = next(x for x in lines if x.startswith("| variant |"))
    assert header.count("|") == line.count("|") == lines[lines.index(header) + 1].count("|")
    assert "2 cores of X" in lines[4] and "Commits: abc (2026-01-02)" in lines[-1]


def test_a_suite_is_trained_and_evaluated_as_a_user_would(tmp_path, monkeypatch):
    asked = []

    def pretend(words, log, threads):
        asked.append((Path(words[0]).name, *words[1:], threads))
        if "--output-path" in words:
            Path(words[words.index("--output-path") + 1]).write_text(json.dumps({"results": {"psnr": 20.0}}))

    monkeypatch.setattr(lab, "run_command", pretend)
    scene = Scene(tmp_path / "scene", 2)
    run, results, made = train_and_evaluate(scene, tmp_path, "mmpi-small", ["--x", "1"], ["--y", "2"], 3)
    assert run == tmp_path / "run" / "mmpi-small" / "1" and results == {"psnr": 20.0}
    place = ("--output-dir", str(tmp_path), "--experiment-name", "run", "--timestamp", "1", "--vis", "tensorboard")
    size = ("--data", str(scene.data), "nerfstudio-data", "--downscale-factor", "2")
    assert asked[0] == ("ns-train", "mmpi-small", *place, "--x", "1", *size, 3)
    found = ("--output-path", str(tmp_path / "eval.json"))
    assert asked[1] == ("ns-eval", "--load-config", str(run / "config.yml"), *found, "--y", "2", 3)
    assert made["threads"] == 3 and made["train_seconds"] >= 0 and {"processor", "commit", "date"} < set(made)


def test_budgets_are_drawn_with_the_default_apart(tmp_path):
    assert [v.name for v in SUITES["kitti-street-budgets"]][-1] == DEFAULT
    rows = {f"{m} M texels": {"texels": m * 1e6, "psnr": 19 + m / 10, "ssim": 0.5 + m / 100} for m in (1, 2, 4)}
    pictures = []
    for more in ({}, {DEFAULT: {"texels": 2e6, "psnr": 19.4, "ssim": 0.55}}):
        results.draw_budgets(tmp_path / "budgets.png", rows | more)
        pictures.append(np.asarray(Image.open(tmp_path / "budgets.png").convert("RGB"), np.int32))
    star = (np.abs(pictures[1] - [214, 39, 40]).max(-1) < 8).sum()
    assert star > 50 and not (np.abs(pictures[0] - [214, 39, 40]).max(-1) < 8).any()


def test_figures_of_pixel_errors_are_those_of_the_head_that_serves_best():
    inf = float("inf")
    plane = np.array([[3.0, 0.0], [9.0, 4.0], [inf, 1.0], [inf, inf]])
    texel = np.array([[8.0, 12.0], [0.0, 6.0], [inf, 2.0], [inf, inf]])
    found = results.error_figures(PixelErrors(plane, texel))
    assert found["unserved"] == 0.25 and found["e_p_50"] == 3 and found["e_t_50"] == 6
    assert found["e_p_90"] == pytest.approx(3.8) and found["e_t_90"] == pytest.approx(7.6)
