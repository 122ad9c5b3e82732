"""benchmarks/render.py: what each setting costs and loses against exact arithmetic."""

from __future__ import annotations

import copy
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import render
import torch
from render import Render, Setting
from stability.exact_ray import ExactField, ExactRay
from training_runs import ready, trainer_config

from mmpi_ns.model import MMPIModelConfig
from mmpi_ns.ops import dispatch


@pytest.fixture(scope="module", params=["two-phase", "joint"])
def run(request, scene, plan_file, tmp_path_factory):
    """A short training, with reliability and without."""
    output = tmp_path_factory.mktemp("run")
    config = trainer_config(scene, plan_file, output, training=request.param, lpips_net="none")
    config.save_config()
    ready(config).train()
    return config.get_base_dir() / "config.yml"


@pytest.fixture(autouse=True)
def usual_ops():
    yield
    dispatch.choose("auto")


def settings(output, **changes):
    return {"images": 2, "rounds": 2, "exact_rays": 60, "chunks": (100,), "output": output} | changes


def test_every_setting_is_timed_and_compared_with_exact_rays(run, tmp_path):
    Render(run, **settings(tmp_path)).run()
    found = json.loads((tmp_path / "render.json").read_text())
    assert all(isinstance(v, int | float) and math.isfinite(v) for v in found["headline"].values())
    assert found["headline"]["exact_rays"] == len(found["exact"]) == 60
    rows = found["rows"]
    assert {r["threshold"] for r in rows.values()} == {0.0, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2}
    assert {r["chunk"] for r in rows.values()} == {100, 16384} and {r["ops"] for r in rows.values()} == {
        "native",
        "torch",
    }
    assert all(len(r["frame_s"]) == 2 * 2 for r in rows.values()), "two images, two rounds"
    kept = [r for r in rows.values() if r["threshold"] == 0]
    assert len(kept) == 2 and all(r["max_error"] < 1e-4 and r["error_999"] <= r["max_error"] for r in kept)
    dropped = [r for r in rows.values() if r["threshold"] == 3e-2]
    assert dropped[0]["error_999"] > 2 * kept[0]["error_999"]
    assert not any(r["also"] for r in rows.values()), "a model with a cube cannot be baked"
    chunks = [r for r in rows.values() if r["threshold"] == 3e-3 and r["ops"] == "native"]
    assert len(chunks) == 2 and chunks[0]["psnr"] == pytest.approx(chunks[1]["psnr"], abs=1e-4)
    text = (tmp_path / "render.md").read_text()
    assert text.count("(default)") == 1 and f"**{found['default']}**" in text
    assert (tmp_path / "render.png").stat().st_size > 10_000


def test_a_model_that_can_be_baked_is_measured_so(tmp_path):
    default = Setting(3e-3, 4096, "native")
    bench = Render(tmp_path / "config.yml", **settings(tmp_path))
    more = set(bench._settings(default, bakes=True)) - set(bench._settings(default, bakes=False))
    assert [s.also for s in more] == ["rendering.mode=baked"]
    model = SimpleNamespace(config=MMPIModelConfig())
    with more.pop().applied(model):  # type: ignore[arg-type]
        assert model.config.rendering.mode == "baked"
    assert model.config.rendering.mode == "auto"


def test_what_was_measured_is_kept(run, tmp_path, monkeypatch):
    Render(run, **settings(tmp_path, thresholds=(0.0,), rounds=1)).run()
    before = json.loads((tmp_path / "render.json").read_text())
    measured, measure = [], render.measure

    def count(model, *rest):
        measured.append(model.config.rendering.threshold)
        return measure(model, *rest)

    monkeypatch.setattr(render, "measure", count)
    monkeypatch.setattr(render, "exact_colors", lambda *_: pytest.fail("rendered exactly again"))
    Render(run, **settings(tmp_path, thresholds=(0.0, 0.5), rounds=1)).run()
    after = json.loads((tmp_path / "render.json").read_text())
    assert measured == [0.5] and {k: after["rows"][k] for k in before["rows"]} == before["rows"]


def test_exact_rays_equal_the_oracle(run):
    pipeline = render.load_model(run)
    model, images = pipeline.model, list(render.images_of(pipeline, 1))
    bundle = images[0][0].generate_rays(camera_indices=0, keep_shape=True)
    origin, direction = (x[5, 7].double().numpy() for x in (bundle.origins, bundle.directions))
    near, blends = float(np.float32(model.field.plan.ray_near)), model.blends(model.field)
    color, made = ExactRay(ExactField.of(model.field), origin, direction, near).render(blends)
    found = render.exact_colors(model, images, [np.array([[5, 7], [6, 7]])])
    assert np.abs(found[0] - color - 0.5 * made.transmittance).max() < 1e-6 < found.std()


def test_what_passes_a_ray_shows_the_background(run):
    pipeline = render.load_model(run)
    model, images = pipeline.model, list(render.images_of(pipeline, 2))
    model.field.density.data.fill_(-100.0)  # as good as empty
    colors = render.exact_colors(model, images, render._some_rays(images, 5))
    assert np.allclose(colors, 0.5) and colors.shape == (5, 3)


def row(threshold, fps, psnr, error):
    also = {"also": "", "chunk": 1, "ops": "torch", "max_error": error}
    return {"threshold": threshold, "frame_s": [1 / fps], "psnr": psnr, "error_999": error, **also}


def test_a_setting_is_off_the_front_where_another_is_faster_without_more_error():
    rows = {
        "all": row(0.0, 1.0, 20.0, 1e-6),
        "default": row(1e-3, 2.0, 19.99, 1e-3),
        "a little faster": row(1e-3, 2.05, 19.99, 1e-3),
        "coarse": row(1e-2, 4.0, 19.5, 1e-2),
    }
    content = {"rows": rows, "pixels": 10, "default": "default", "exact": [0] * 7}
    found = {r["name"]: r for r in render._rows(content)}
    assert [r["on_front"] for r in found.values()] == [True] * 4, "2.5 % are noise"
    assert found["coarse"]["loss"] == pytest.approx(0.5) and found["coarse"]["rays_per_s"] == pytest.approx(40)
    head = render.headline(content)
    assert head["default_on_front"] == 1 and head["fastest_at_no_more_loss_over_default"] == pytest.approx(1.025)
    rows["better"] = row(2e-3, 3.0, 19.995, 5e-4)
    assert render.headline(content)["default_on_front"] == 0
    rows["better"]["error_999"] = 2e-3
    assert render.headline(content)["default_on_front"] == 1, "less error by one measure, more by the other"


def test_a_further_setting_of_the_model_is_tried_with_its_own_type_and_taken_back():
    model = SimpleNamespace(config=MMPIModelConfig(eval_num_rays_per_chunk=1))
    usual = copy.deepcopy(model.config)
    with Setting(0.25, 7, "torch", "sampling.threshold=0.5").applied(model):  # type: ignore[arg-type]
        assert (model.config.rendering.threshold, model.config.eval_num_rays_per_chunk) == (0.25, 7)
        assert model.config.sampling.threshold == 0.5 and dispatch.form_of("march", torch.zeros(1)) == "reference"
    assert model.config == usual
    assert dispatch.form_of("march", torch.zeros(1)) == "cpu"
    with Setting(0.25, 7, "auto", "rendering.background=white").applied(model):  # type: ignore[arg-type]
        assert model.config.rendering.background == "white"
    assert model.config == usual
