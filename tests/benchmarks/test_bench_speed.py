"""benchmarks/speed.py and ``ops`` on the tiny scene."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import ops
import pytest
import speed
import torch
import trainings
from all_planes import DenseSteps
from methods import METHODS
from ops import Ops
from speed import Speed
from torchmetrics.image import lpip

from mmpi_ns.bench.trainers import Scene, Steps


def train_here(request, threads):
    return trainings.train(asdict(request), lambda text: None)


def rounds_here(work, request, folder, threads):
    return work(request, lambda text: None)


def command(scene, folder, **changes):
    settings = {"arrangement": "automatic", "planes": 16, "steps": 10, "rounds": 2, "dense_steps": 1}
    settings |= {"nerfacto_steps": 1, "rays": 64, "test_images": 0, "threads": 1, "full_size": 2} | changes
    return Speed(data=scene, downscale_factor=1, output=folder / "results", work=folder / "work", **settings)


@pytest.mark.commands
def test_speed_end_to_end_and_again(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(lpip, "LearnedPerceptualImagePatchSimilarity", None)  # its weights would be fetched
    monkeypatch.setattr(speed, "train_apart", train_here)
    monkeypatch.setattr(speed, "run_apart", rounds_here)
    command(scene, tmp_path).run()
    found = json.loads((tmp_path / "results" / "speed.json").read_text())
    head, rounds = found["headline"], found["rows"]["rounds"]
    wanted = {"rays_per_s", "dense_rays_per_s", "nerfacto_rays_per_s", "psnr_delta_db", "frame_s", "frame_full_s"}
    assert wanted | {"peak_memory_gib", "times_dense", "times_nerfacto"} <= set(head)
    assert all(isinstance(v, int | float) and math.isfinite(v) for v in head.values())
    assert len(rounds["rays_per_s"]) == 2 and rounds["frame_pixels"] == 32 * 24
    assert rounds["frame_full_pixels"] == 64 * 48 and rounds["dense_samples"] % 16 == 0
    assert found["rows"]["ours"]["images"] == 2 and found["rows"]["ours"]["rays"] == 640
    assert head["psnr_delta_db"] == pytest.approx(head["psnr_db"] - head["dense_psnr_db"])
    assert "| ours | dense | nerfacto |" in (tmp_path / "results" / "speed.md").read_text()
    for name in ("train_apart", "run_apart"):
        monkeypatch.setattr(speed, name, lambda *_: pytest.fail("measured again"))
    command(scene, tmp_path).run()


def test_medians_are_of_neighbours_in_time():
    rounds = {"rays_per_s": [10.0, 20.0, 60.0], "dense_rays_per_s": [5.0, 4.0, 6.0], "whole_run_rays_per_s": 7.0}
    rounds |= {"nerfacto_rays_per_s": [1.0, 1.0, 2.0], "frame_s": [1.0, 2.0, 9.0]}
    rows = {"rounds": rounds, "ours": {"psnr": 20.0, "peak_gib": 1.0}, "keep all": {"psnr": 20.5, "peak_gib": 2.0}}
    found = speed.headline(rows)
    assert found["rays_per_s"] == 20 and found["frame_s"] == 2
    assert found["times_dense"] == 5 and found["times_nerfacto"] == 20
    assert found["psnr_delta_db"] == -0.5


@pytest.fixture(scope="module")
def steps(scene, tmp_path_factory):
    words = METHODS["mmpi-small"].words(Scene(scene, 1), tmp_path_factory.mktemp("steps"), 20, 64, 0, "cpu")
    return Steps([*words[:1], "--pipeline.model.placement.max-planes", "16", *words[1:]])


def test_dense_steps_learn_and_train_on_every_plane(steps):
    dense = DenseSteps(steps)
    before = dense.field.features.detach().clone()
    assert dense.run(2) > 0 and dense.step == 2
    assert dense.samples == sum(m.planes for m in dense.field.plan.mpis)
    assert not torch.equal(before, dense.field.features.detach())
    assert dense.field.plan == steps.pipeline.model.field.full_plan, "at all its texels"


def test_steps_are_those_of_nerfstudios_loop(steps, scene, tmp_path):
    """The same weights as after as many steps of the trainer's own loop."""
    step = steps.step
    steps.run(6 - step)
    words = METHODS["mmpi-small"].words(Scene(scene, 1), tmp_path, 20, 64, 0, "cpu")
    other = Steps([*words[:1], "--pipeline.model.placement.max-planes", "16", *words[1:]])
    other.trainer._total_steps = 6  # its schedule stays that of 20
    other.trainer.train()
    for a, b in zip(steps.pipeline.model.parameters(), other.pipeline.model.parameters(), strict=True):
        assert torch.equal(a, b)
    seconds, pixels = steps.render(larger=3)
    assert seconds > 0 and pixels == 96 * 72
    assert steps.render(rays=50)[1] == 50


def test_ops_end_to_end_and_again(scene, tmp_path, monkeypatch):
    made = Ops(
        data=scene, downscale_factor=1, early=2, steps=6, rays=64, repeats=1, output=tmp_path, work=tmp_path / "work"
    )
    monkeypatch.setattr(ops, "COPIED", 1 << 16)
    made.run()
    found = json.loads((tmp_path / "ops.json").read_text())
    assert all(isinstance(v, int | float) and math.isfinite(v) and v > 0 for v in found["headline"].values())
    for stage in ("early", "late"):
        counts, rows = found["rows"][stage]["counts"], found["rows"][stage]["ops"]
        assert counts["pixels"] == 64 * 1.75 and 0 < counts["kept"] <= counts["live"] and len(rows) == 12
        assert counts["rows"] <= 4 * counts["kept"]
        assert f"{stage}_interpolation_backward_ms" in found["headline"]
        assert f"{stage}_adam_of_limit" in found["headline"]
    monkeypatch.setattr(Ops, "_measure", lambda _: pytest.fail("measured again"))
    made.run()
    with pytest.raises(ValueError, match="between 0 and --steps"):
        Ops(data=scene, early=9, steps=9).run()


def test_operations_do_what_their_names_say(steps):
    """Each is called twice, in any order, and leaves no gradient behind."""
    model = steps.pipeline.model
    made, counts = ops.operations(model.train(), steps)
    work = {op.name: op.work for op in made}
    assert len(work) == len(made)
    field = model.field
    for _ in range(2):
        for name in reversed(work):
            before = field.features.detach().clone()
            work[name]()
            assert torch.equal(before, field.features.detach()) == (name != "Adam"), name
            assert field.features.grad is None and field.networks.weights.grad is None, name
    values = work["interpolation"]()
    assert values.shape == (counts["kept"], field.feature_channels)
    assert work["index of rows"]().unique.numel() == counts["rows"]
    assert work["colours of rays"]().shape == (counts["rays"], 3)
    _, valid = work["merge by a sort"]()
    assert int(valid.sum()) == counts["live"]


def test_an_operation_is_held_to_its_bytes_or_its_sums():
    limits = {"copy_gb_per_s": 10.0, "matmul_gflop_per_s": 100.0}
    assert ops.limit_ms({"mb": 20.0, "mflop": 0.0}, limits) == 2.0
    assert ops.limit_ms({"mb": 20.0, "mflop": 400.0}, limits) == 4.0
