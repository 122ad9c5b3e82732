"""The dense reference that speed is measured against renders the same field."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from mmpi_ns.bench import apart
from mmpi_ns.bench.apart import train_and_evaluate
from mmpi_ns.bench.quality import regions, results
from mmpi_ns.bench.quality.regions import Regions, spearman
from mmpi_ns.bench.report import Scene
from mmpi_ns.bench.speed.all_planes import render_densely
from mmpi_ns.bench.speed.scaling import BASE, made_up_batch, render_ours
from mmpi_ns.bench.suites import DEFAULT, SUITES
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.scene.plan import MPIPlan, ScenePlan


def test_the_dense_reference_renders_what_the_sampler_renders():
    torch.manual_seed(0)
    field = MMPIField(BASE.plan().scaled(1 / 64), hidden_width=8, shares_depth=True)
    with torch.no_grad():
        field.density.normal_(std=3)
        field.features.normal_()
    bundle, _ = made_up_batch(64)
    ours, _ = render_ours(field, bundle, young=False, threshold=0.0)
    reference, _ = render_densely(field, bundle)
    # The reference leaves out colours below alpha = 1e-4, so they may differ by that much a sample.
    assert float((ours - reference).abs().max()) < 5e-3
    assert float(ours.std()) > 0.05


def test_rows_of_a_suite_have_different_names():
    for variants in SUITES.values():
        keys = [(v.group, v.name) for v in variants]
        assert len(set(keys)) == len(keys)


def test_rank_correlation_asks_for_order_alone():
    a = np.array([3.0, 1.0, 2.0, 10.0])
    assert spearman(a, np.exp(a)) == pytest.approx(1)
    assert spearman(a, -a) == pytest.approx(-1)
    # Ties share their mean rank: ranks (1.5, 1.5, 3, 4) against (1, 2, 3, 4).
    assert spearman(np.array([5.0, 5.0, 6.0, 7.0]), np.arange(4.0)) == pytest.approx(0.9486832981)


def test_regions_pair_what_is_expected_with_what_is_measured_there():
    """A camera at the origin looks along -z at three groups of points; its image is 40 x 30, regions 10 x 10."""
    groups = {(2.0, 7.0): 6, (33.0, 22.0): 5, (22.0, 12.0): 4}  # the last is too small
    pixels = np.repeat(list(groups), list(groups.values()), axis=0)
    depth = np.concatenate([np.full(6, 10.0), np.full(5, 20.0), np.full(4, 5.0)])
    points = np.column_stack([(pixels[:, 0] - 20) / 25, -(pixels[:, 1] - 15) / 25, -np.ones(15)]) * depth[:, None]
    behind = -points[:6]
    camera = SimpleNamespace(
        fx=25.0, fy=25.0, cx=20.0, cy=15.0, width=40, height=30, camera_to_worlds=torch.eye(4)[None, :3]
    )
    axes = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    # 3 behind the camera: a texel of 0.04 spans 25 * 0.04 * D / (D - 3) pixels at the depth D in the MPI.
    mpi = MPIPlan("one", (0.0, 0.0, 3.0), axes, 4.0, (-1.0, 1.0, -1.0, 1.0), 4096, 51, 51)
    squared = np.arange(1200.0).reshape(30, 40)
    found = Regions(Path(), rows=3, columns=4)._regions(
        regions._as_observations(camera), np.concatenate([points, behind]), ScenePlan((mpi,), None, 0.1, 1.0), squared
    )
    assert [f[0] for f in found] == pytest.approx([0.5 * 13 / 10, 0.5 * 23 / 20], rel=1e-3)
    cells = squared[:10, :10], squared[20:, 30:]
    assert [f[1] for f in found] == pytest.approx([np.sqrt(c.mean()) for c in cells])


def test_the_slope_of_an_image_is_its_change_over_a_pixel():
    ramp = np.arange(12.0)[None, :, None] * [0.3, 0.6, 0.0] + np.arange(9.0)[:, None, None] * [0.0, 0.0, 0.9]
    assert regions.squared_slope(ramp) == pytest.approx(np.full((9, 12), (0.09 + 0.36 + 0.81) / 3))


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

    monkeypatch.setattr(apart, "run_command", pretend)
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
