"""Baking a model: its images against the exact renderer's, in one window and several, blended and not; refusals."""

from __future__ import annotations

import copy
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from random_fields import random_rays
from training_runs import ready, trainer_config, write_plan

from mmpi_ns.field.shading import RayShader
from mmpi_ns.rendering.rendered import bounded, render_outputs
from mmpi_ns.scene.plan import CubePlan
from mmpi_show import __main__ as export
from mmpi_show.bake import bake_run, compare
from mmpi_show.files import read_baked, write_baked
from mmpi_show.windows import bake


@pytest.fixture(scope="module")
def trainer(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    plan = write_plan(scene, folder / "plan.json", planes=40)
    config = trainer_config(scene, plan, folder, shading="ray")
    config.save_config()
    return ready(config)


def filled(trainer, seed=0):
    """A model whose densities, colours and features are random."""
    model = trainer.pipeline.model.eval()
    field, g = model.field, torch.Generator().manual_seed(seed)
    field.density.data[64:] = torch.randn(len(field.density) - 64, 1, generator=g) * 2 + 1.5
    field.features.data[64:] = torch.randn(len(field.features) - 64, field.feature_channels, generator=g)
    field.reliability.data = torch.randn(field.reliability.shape, generator=g)
    field.touched.fill_(1)
    field.networks.weights.data = torch.randn(field.networks.weights.shape, generator=g) * 0.2
    return model


def bundle_of(plan, count=400):
    o, d = (torch.tensor(x, dtype=torch.float32) for x in random_rays(plan, count, 3))
    return RayBundle(
        origins=o, directions=d, pixel_area=torch.ones(count, 1), camera_indices=torch.zeros(count, 1).int()
    )


def outputs(model, how, rays):
    """Of the exact renderer, or of the baked window."""
    with torch.no_grad():
        if how == "exact":
            return model.get_outputs(copy.deepcopy(rays))
        bundle, field = bounded(copy.deepcopy(rays), model.field.plan), model.field
        drawn = bake(model, field).render(bundle.origins, bundle.directions)
        return drawn | {"winning_mpi": field.planned_heads(drawn["winning_mpi"])}


def test_baked_images_are_the_exact_ones(trainer, monkeypatch):
    """The same colours to the error of 8 bits, the same depths and winners nearly everywhere; joint, so not blended."""
    model = filled(trainer)
    monkeypatch.setattr(model.field, "learns_reliability", False)
    rays = bundle_of(model.field.plan)
    exact, baked = outputs(model, "exact", rays), outputs(model, "baked", rays)
    assert set(exact) == set(baked) and all(exact[n].shape == baked[n].shape for n in exact)
    assert exact["rgb"].std() > 0.05
    assert (exact["rgb"] - baked["rgb"]).square().mean() < 1e-4  # 40 dB
    torch.testing.assert_close(exact["accumulation"], baked["accumulation"], atol=0.02, rtol=0)
    assert ((exact["depth"] / baked["depth"]).log().abs() < 0.01).float().mean() > 0.9
    assert (exact["winning_mpi"] == baked["winning_mpi"]).float().mean() > 0.95


def test_finer_copies_are_baked_and_shown_as_parts_of_their_mpis(trainer, monkeypatch, request):
    model = filled(trainer)
    field, count = model.field, len(model.field.plan.mpis)
    plan, factor = field.full_plan, field.factor
    monkeypatch.setattr(model.field, "learns_reliability", False)
    rays = bundle_of(field.plan)
    chosen = (field.tiles > 0) & (torch.rand(len(field.tiles), generator=torch.Generator().manual_seed(1)) < 0.6)
    field.copy_finely(chosen)
    request.addfinalizer(lambda: field.build(plan, factor))
    exact, baked = outputs(model, "exact", rays), outputs(model, "baked", rays)
    assert (exact["rgb"] - baked["rgb"]).square().mean() < 1e-4 and exact["rgb"].std() > 0.05
    for each in (exact, baked):
        assert 0 <= each["winning_mpi"].min() and each["winning_mpi"].max() < count
    assert (exact["winning_mpi"] == baked["winning_mpi"]).float().mean() > 0.95
    model.show.value = model.progress.windows.names[0]
    alone = outputs(model, "exact", rays)
    model.show.value = "all"
    head_mask = (torch.arange(2 * count) % count == 0).expand(len(rays), -1)
    with torch.no_grad():
        result = render_outputs(bounded(rays, field.plan), field, blends=False, threshold=3e-3, head_mask=head_mask)
    torch.testing.assert_close(alone["accumulation"], result["accumulation"])
    torch.testing.assert_close(alone["depth"], result["depth"])
    assert (alone["depth"] / exact["depth"] - 1).abs().max() > 0.1


def test_blending_is_baked_into_the_bricks(trainer, monkeypatch):
    """Two phases: bricks hold blended densities, and differ from those that are not; shares are interpolated."""
    model = filled(trainer, 1)
    model.field.reliability.data[:] = 0.0
    for k, grid in enumerate(model.field.grids):  # one vote a head: shares change where covers end alone
        rows = torch.arange(64, len(model.field.density))
        model.field.reliability.data[rows[grid.holds(rows)]] = 1.5 * k
    rays = bundle_of(model.field.plan)
    exact, baked = outputs(model, "exact", rays), outputs(model, "baked", rays)
    error = (exact["rgb"] - baked["rgb"]).square().mean()
    monkeypatch.setattr(model.field, "learns_reliability", False)
    unblended = outputs(model, "baked", rays)
    assert error < 1e-3 and error < 0.2 * (exact["rgb"] - unblended["rgb"]).square().mean()


def test_a_run_is_baked_and_read_again(trainer, tmp_path, capsys, monkeypatch):
    """What seen bricks show is what all show, and the file gives the same images."""
    model = filled(trainer)
    monkeypatch.setattr("mmpi_show.bake.load_model", lambda *_: trainer.pipeline)
    scene = export.Bake(tmp_path / "config.yml", compare=2).bake()
    whole, told = bake(model, model.field), capsys.readouterr().out
    kept = scene.windows[0][1]
    assert 0 < kept.mpis.num_bricks < whole.mpis.num_bricks
    assert "bricks are seen" in told and "dB to the exact renderer's" in told
    assert len(scene.path) == 8 and sum(pose.test for pose in scene.path) == 2
    write_baked(scene, tmp_path)
    for which in (scene, read_baked(tmp_path)):
        actual = compare(trainer.pipeline, which, 2)
        exact, baked = actual["exact"], actual["baked"]
        assert baked["to_exact"] > 35 and abs(exact["psnr"] - baked["psnr"]) < 0.3
        assert abs(exact["ssim"] - baked["ssim"]) < 0.01 and baked["seconds"] > 0
    assert bake_run(trainer.pipeline, 0).windows[0][1].mpis.num_bricks == whole.mpis.num_bricks


def test_what_cannot_be_baked_is_refused(trainer, monkeypatch):
    model = filled(trainer)
    monkeypatch.setattr(model.field, "feature_channels", 17)
    with pytest.raises(ValueError, match="16 is the most"):
        bake(model, model.field)
    monkeypatch.undo()
    cube = CubePlan((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2, 2, 2))
    monkeypatch.setattr(model.field, "plan", replace(model.field.plan, cube=cube))
    with pytest.raises(ValueError, match="cube"):
        bake(model, model.field)
    monkeypatch.undo()
    assert isinstance(model.field.networks, RayShader)
    model.field._modules["networks"] = torch.nn.Linear(1, 1)
    try:
        with pytest.raises(ValueError, match="shading ray"):
            bake(model, model.field)
    finally:
        model.field._modules["networks"] = RayShader(1, 4, 8, 2)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["bake", "--load-config", "nothing/config.yml"], "There is no run at nothing/config.yml"),
        (["bake", "--load-config", "run/config.yml"], "The run has no checkpoint"),
        (["web", "--load-config", "run2/config.yml", "--output", "used"], "used holds other files"),
        (["web", "--load-config", "run2/config.yml", "--output", "home", "--overwrite"], "home holds other files"),
        (["web", "--load-config", "run2/config.yml", "--output", "export"], "give --overwrite"),
        (["web", "--load-config", "run2/config.yml", "--output", "file"], "file is a file"),
        (
            ["web", "--load-config", "run2/config.yml", "--output", "one.html", "--single-file"],
            "one.html is there already",
        ),
        (["splats", "--load-config", "run2/config.yml", "--output", "file"], "file is there already"),
        (["splats", "--load-config", "run2/config.yml", "--output", "a.ply"], "a-00001.ply is there already"),
    ],
)
def test_mistakes_are_one_sentence(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for folder in ("run", "run2/nerfstudio_models", "used", "home", "export"):
        Path(folder).mkdir(parents=True)
    files = ("run/config.yml", "run2/config.yml", "used/notes.txt", "export/scene.json", "file", "one.html")
    for name in (*files, "a-00001.ply", "home/index.html", "run2/nerfstudio_models/step-000000001.ckpt"):
        Path(name).write_text("{}")
    monkeypatch.setattr(sys, "argv", ["mmpi-export", *arguments])
    with pytest.raises(SystemExit) as caught:
        export.entrypoint()
    said = capsys.readouterr().err.strip()
    assert caught.value.code == 1 and said.startswith("mmpi-export: ") and words in said and "\n" not in said
    assert all(Path(name).read_text() == "{}" for name in files)
