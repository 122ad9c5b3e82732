"""benchmarks/train.py: equal data for every method, the clock, what is kept, what is named as not run."""

from __future__ import annotations

import dataclasses
import json
import math
import random
from pathlib import Path
from types import SimpleNamespace

import methods
import numpy as np
import pytest
import torch
import train
import trainings
from apart import run_apart
from curves import Curve, compare
from methods import METHODS
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.depth_dataset import DepthDataset
from torchmetrics.image import lpip
from train import Train
from train_report import headline, markdown

from mmpi_ns.bench.trainers import Steps
from mmpi_ns.data import datamanager
from mmpi_ns.data.priors import DepthPriors, packed


def in_this_process(request, threads):
    """Instead of a fresh one, which takes seconds to import everything."""
    said = []
    row = trainings.train(dataclasses.asdict(request), said.append)
    assert [line.split(":")[0] for line in said] == [f"step {n}" for n in request.checks]
    return row


def command(scene, folder, **settings) -> Train:
    settings = {
        "methods": ("mmpi-small", "single", "splatfacto"),
        "steps": ("mmpi-small=6", "single=3"),
        "rays_per_batch": ("mmpi-small=64", "single=64", "nerfacto=64"),
        "seeds": (0, 1),
        "threads": 1,
        "device": "cpu",
        "check_pixels": 50,
    } | settings
    return Train((scene,), 1, output=folder / "results", work=folder / "work", **settings)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """Two methods and two seeds on the tiny scene; a third that needs a GPU."""
    folder = tmp_path_factory.mktemp("train")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "train_apart", in_this_process)
        command(scene, folder).run()
    return folder


def read(folder) -> dict:
    return json.loads((folder / "results" / "train.json").read_text())


def test_every_method_is_trained_and_scored_on_the_scenes_own_lists(trained):
    rows = [r for r in read(trained)["rows"].values() if "not_run" not in r]
    assert [(r["method"], r["seed"]) for r in rows] == [(m, s) for s in (0, 1) for m in ("mmpi-small", "single")]
    for row in rows:
        assert (row["split"]["train"], row["split"]["test"], row["images"]) == (6, 2, 2)
        assert row["split"]["size"] == [32, 24] and row["split"]["digest"] == rows[0]["split"]["digest"]
        last = {"mmpi-small": 6, "single": 3}[row["method"]]
        assert row["curve"][-1]["step"] == last and row["rays"] == 64 * last
        assert [p["rays"] for p in row["curve"]] == [64 * p["step"] for p in row["curve"]]
        seconds = [p["seconds"] for p in row["curve"]]
        assert seconds == sorted(seconds) and row["setup_seconds"] < seconds[0]
    small, single = rows[0], rows[1]
    assert small["parameters"] != single["parameters"] or small["psnr"] != single["psnr"]
    assert rows[0]["psnr"] != rows[2]["psnr"], "seeds must make a difference"


def test_the_headline_holds_finite_numbers_alone(trained):
    found = read(trained)["headline"]
    assert {"mmpi_small_psnr_db", "mmpi_small_psnr_spread_db", "mmpi_small_seconds", "single_psnr_db"} <= set(found)
    assert all(isinstance(v, int | float) and math.isfinite(v) for v in found.values())
    rows = [r for r in read(trained)["rows"].values() if r["method"] == "mmpi-small"]
    assert found["mmpi_small_psnr_db"] == pytest.approx((rows[0]["psnr"] + rows[1]["psnr"]) / 2)
    assert (trained / "results" / "train.png").stat().st_size > 10_000


def test_what_cannot_run_is_named_with_the_reason(trained):
    text = (trained / "results" / "train.md").read_text()
    assert "- splatfacto on tiny: it needs a CUDA device" in text
    assert text.count("splatfacto on tiny") == 1, "once, not for every seed"
    assert text.count("| mmpi-small | SfM tracks | 6 |") == 1 and "±" in text


def test_finished_rows_are_kept_and_others_are_run_again(scene, trained, monkeypatch):
    before, asked = read(trained)["rows"], []

    def refuse(request, threads):
        asked.append(request.words[0])
        return {"not_run": "it failed"}

    monkeypatch.setattr(train, "train_apart", refuse)
    command(scene, trained).run()
    assert asked == []
    assert {k: v for k, v in read(trained)["rows"].items() if "not_run" not in v} == {
        k: v for k, v in before.items() if "not_run" not in v
    }
    command(scene, trained, methods=("mmpi-small",), seeds=(2,)).run()
    command(scene, trained, methods=("mmpi-small",), seeds=(2,)).run()
    assert asked == ["mmpi-small"] * 2, "a row that failed is tried again"


@pytest.mark.commands
def test_nerfacto_trains_through_nerfstudios_own_trainer(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(lpip, "LearnedPerceptualImagePatchSimilarity", None)  # its weights would be fetched
    monkeypatch.setattr(train, "train_apart", in_this_process)
    command(scene, tmp_path, methods=("nerfacto",), steps=("nerfacto=2",), seeds=(0,)).run()
    (row,) = read(tmp_path)["rows"].values()
    assert row["rays"] == 128 and row["curve"][-1]["step"] == 2 and 3 < row["psnr"] < 40
    assert "--pipeline.model.camera-optimizer.mode off" in row["options"]
    assert not any("lpips" in k for k in row) and row["options"].startswith("nerfacto ")
    assert not list((tmp_path / "work").rglob("*.ckpt"))


@pytest.mark.commands
def test_depth_nerfacto_is_given_the_depths_that_ours_finds(scene, tmp_path, monkeypatch):
    maps = [np.full((24, 32, 2), 0.25 + 0.01 * i, np.float32) for i in range(6)]
    maps[0][:12] = 0  # half of an image is not known
    known = DepthPriors([packed(m) for m in maps])
    monkeypatch.setattr(datamanager, "make_depth_priors", lambda outputs, tracks, dataset, rays, **how: (known, tracks))
    for name in ("__init__", "get_metadata"):  # put back afterwards
        monkeypatch.setattr(DepthDataset, name, getattr(DepthDataset, name))
    monkeypatch.setattr(train, "train_apart", in_this_process)
    command(scene, tmp_path, methods=("depth-nerfacto",), steps=("depth-nerfacto=2",), seeds=(0,)).run()
    (row,) = read(tmp_path)["rows"].values()
    assert row["curve"][-1]["step"] == 2 and 3 < row["psnr"] < 40
    text = (tmp_path / "results" / "train.md").read_text()
    assert "| depth-nerfacto | the depths of mmpi-small | 2 |" in text
    config = NerfstudioDataParserConfig(data=scene, downscale_factor=1)
    for split, wanted in (("train", [m[..., :1] for m in maps]), ("test", np.zeros((2, 24, 32, 1)))):
        held = DepthDataset(config.setup().get_dataparser_outputs(split=split))
        for i, inverse in enumerate(wanted):
            distance = held[i]["depth_image"].numpy()
            assert np.array_equal(distance > 0, inverse > 0)
            assert np.allclose((distance * inverse)[inverse > 0], 1, atol=1e-3)


@pytest.mark.commands
def test_a_peer_that_was_cut_off_or_was_shorter_goes_on_from_its_last_check(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # as train_apart does
    said = []

    def here(request, threads):
        said.append([])
        return trainings.train(dataclasses.asdict(request), said[-1].append)

    def nerfacto(steps: int, **settings) -> dict:
        settings = {"methods": ("nerfacto",), "seeds": (0,), "keep": True} | settings
        command(scene, tmp_path, steps=(f"nerfacto={steps}",), **settings).run()
        return next(r for r in read(tmp_path)["rows"].values() if r["steps"] == steps)

    monkeypatch.setattr(train, "train_apart", here)
    short = nerfacto(2)
    longer = nerfacto(5, check_every=2)
    assert said[1][0] == "goes on from step 2" and [line.split(":")[0] for line in said[1][1:]] == ["step 4", "step 5"]
    assert longer["curve"][: len(short["curve"])] == short["curve"]
    assert [p["rays"] for p in longer["curve"]] == [64 * p["step"] for p in longer["curve"]] and longer["rays"] == 320
    seconds = [p["seconds"] for p in longer["curve"]]
    assert seconds == sorted(seconds) and longer["setup_seconds"] == short["setup_seconds"]
    nerfacto(1)
    assert said[2][0].startswith("step 1:"), "a longer run is no start for a shorter one"
    nerfacto(4, keep=False)
    assert said[3][0].startswith("step 1:"), "nothing goes on that was not asked to be kept"


def test_a_process_is_told_what_its_request_needs(tmp_path, monkeypatch):
    given = {}
    monkeypatch.setattr(trainings, "run_apart", lambda *a: given.update(a[-1]) or {})
    request = trainings.Request((), "", 1, str(tmp_path), (1,))
    trainings.train_apart(request, 1)
    assert given == {}, "methods run as they are"
    trainings.train_apart(dataclasses.replace(request, go_on=True), 1)
    assert given == {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}
    trainings.train_apart(dataclasses.replace(request, quick_hashes=True), 1)
    assert any(name.startswith("MALLOC_") for name in given)


def test_quick_hashes_are_for_hash_tables_and_have_rows_of_their_own(scene, tmp_path):
    quick = command(scene, tmp_path, quick_hashes=True, keep=True)
    asked = {name: quick._request(scene, METHODS[name], 3, 0, tmp_path) for name in ("nerfacto", "mmpi-small")}
    assert asked["nerfacto"].quick_hashes and not asked["mmpi-small"].quick_hashes
    assert asked["nerfacto"].go_on and not asked["mmpi-small"].go_on, "our schedules follow the length of a run"
    keys = [c._key(scene, METHODS["nerfacto"], 3, 0) for c in (quick, command(scene, tmp_path))]
    assert keys[0] == keys[1].replace("nerfacto", "nerfacto (quick hashes)")


def test_a_process_that_fails_says_why_and_where(tmp_path):
    nothing = SimpleNamespace(__module__="mmpi_ns.bench.nothing", __qualname__="measure")
    row = run_apart(nothing, {}, tmp_path, 1)
    assert row["not_run"].startswith("it failed with status 1 (") and "No module named" in row["not_run"]
    assert row["not_run"].endswith(f"see {tmp_path / 'output.log'}")
    assert "nothing" in (tmp_path / "output.log").read_text()


@pytest.mark.commands
def test_a_process_answers_with_the_threads_that_it_was_given(tmp_path, monkeypatch):
    lines = ("import torch", "def count(asked, tell): return {**asked, 'threads': torch.get_num_threads()}")
    (tmp_path / "counter.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    count = SimpleNamespace(__module__="counter", __qualname__="count")
    assert run_apart(count, {"asked": 5}, tmp_path / "run", 1) == {"asked": 5, "threads": 1}


def test_a_scene_whose_test_images_are_not_the_ones_evaluated_is_refused(scene):
    split = {"train": [str(scene / f"images/frame_{i + 1:05d}.png") for i in (0, 1, 3, 4, 6, 7)]}
    split["test"] = [str(scene / f"images/frame_{i + 1:05d}.png") for i in (2, 5)]
    trainings.check_split(split, scene, 1)
    with pytest.raises(ValueError, match="val and test must be equal"):
        trainings.check_split({**split, "test": split["test"][:1]}, scene, 1)


def test_rows_with_different_images_cannot_stand_in_one_table():
    rows = {
        name: {"scene": "a", "downscale_factor": 4, "split": {"digest": digest}}
        for name, digest in (("x", "1"), ("y", "1"))
    }
    train.check_equal_data(rows)
    rows["y"]["split"]["digest"] = "2"
    with pytest.raises(RuntimeError, match="y and x"):
        train.check_equal_data(rows)


def test_the_clock_stands_still_and_random_draws_go_on_as_if_nothing_was(monkeypatch):
    now = [10.0]
    monkeypatch.setattr(trainings, "_now", lambda: np.array([now[0], now[0] / 2]))
    watch = trainings.Stopwatch()
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    wanted = torch.rand(2), np.random.rand()  # noqa: NPY002
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    now[0] = 12.0
    with watch.stopped():
        now[0] = 112.0
        torch.rand(5)
        np.random.rand()  # noqa: NPY002
    now[0] = 113.0
    assert watch.read() == {"seconds": 3.0, "processor": 1.5}
    assert torch.equal(torch.rand(2), wanted[0]) and np.random.rand() == wanted[1]  # noqa: NPY002


def test_test_pixels_are_the_same_for_every_method():
    a = trainings.chosen_pixels(3, 20, 30, 50)
    random.random()
    torch.rand(3)
    assert torch.equal(a, trainings.chosen_pixels(3, 20, 30, 50)) and len(set(a.tolist())) == 50
    assert not torch.equal(a, trainings.chosen_pixels(4, 20, 30, 50))
    assert sorted(trainings.chosen_pixels(0, 4, 5, 0).tolist()) == list(range(20))
    assert trainings.evenly(42, 3) == [7, 21, 35] and trainings.evenly(5, 0) == trainings.evenly(5, 9) == [
        0,
        1,
        2,
        3,
        4,
    ]


def test_methods_that_render_whole_images_are_scored_on_the_same_pixels(scene, tmp_path):
    request = command(scene, tmp_path)._request(scene, METHODS["mmpi-small"], 2, 0, tmp_path)
    trainer = Steps(list(request.words)).trainer
    one, whole = (trainings.score(trainer.pipeline, [1], 40, way) for way in (False, True))
    assert one["psnr"] == pytest.approx(whole["psnr"], abs=1e-4) and one["images"] == whole["images"] == 1
    assert one["psnr"] != trainings.score(trainer.pipeline, [0], 40, False)["psnr"]
    full = trainings.score(trainer.pipeline, [0, 1], 0, True)
    assert full["images"] == 2 and "ssim" in full and full["rays_per_s"] > 0


def test_splats_count_the_pixels_of_images_that_grow():
    manager = SimpleNamespace(get_train_rays_per_batch=lambda: 1200)
    model = SimpleNamespace()
    pipeline = SimpleNamespace(datamanager=manager, model=model)
    assert trainings.pixels_of_step(pipeline) == 1200
    model._get_downscale_factor = lambda: 4
    assert trainings.pixels_of_step(pipeline) == 75


def curve(seconds, psnr, seed=0):
    points = [
        {"step": 100 * (i + 1), "rays": 10, "seconds": s, "psnr": p}
        for i, (s, p) in enumerate(zip(seconds, psnr, strict=True))
    ]
    return {"curve": points, "seed": seed}


def test_curves_are_means_over_seeds_read_over_the_logarithm_of_time():
    c = Curve.of([curve([1, 10, 100], [10, 14, 20]), curve([1, 10, 100], [12, 16, 20])])
    assert c.psnr.tolist() == [11, 15, 20] and c.lowest.tolist() == [10, 14, 20] and c.highest.tolist() == [12, 16, 20]
    assert c.at(10**0.5) == pytest.approx(13) and c.at(0.5) is None and c.at(101) is None
    assert c.reaches(17.5) == pytest.approx(10**1.5) and c.reaches(9) == 1 and c.reaches(20.1) is None
    assert c.last_gain() == pytest.approx(50)
    other = curve([1, 5, 100], [12, 13, 20])
    other["curve"][1]["step"] = 150  # a run that went on from a shorter one was looked at more often
    ragged = Curve.of([curve([1, 10, 100], [10, 14, 20]), other])
    assert ragged.steps.tolist() == [100, 300] and ragged.psnr.tolist() == [11, 20]


def test_a_comparison_takes_the_better_of_runs_of_several_lengths():
    short, long = Curve.of([curve([1, 10], [10, 18])]), Curve.of([curve([1, 10, 100], [10, 15, 22])])
    peer = Curve.of([curve([10, 100, 1000], [8, 12, 18])])
    found = compare([short, long], peer, "nerfacto")
    assert found["equal_time_s"] == 100 and found["delta_at_equal_time_db"] == pytest.approx(22 - 12)
    assert found["seconds_to_nerfacto_psnr"] == pytest.approx(10)
    assert found["time_ratio_to_nerfacto_psnr"] == pytest.approx(100)
    worse = Curve.of([curve([1, 10], [5, 6])])
    assert "seconds_to_nerfacto_psnr" not in compare([worse], peer, "nerfacto")


def test_a_report_compares_with_the_peer_and_tells_scenes_apart():
    def row(method, scene, psnr, seconds):
        made = {"command": "c", "commit": "abc", "date": "2026-01-02", "threads": 2, "ours": method[0] == "m"}
        made |= {"scene": scene, "downscale_factor": 4, "method": method, "steps": 300, "ssim": 0.5, "psnr": psnr[-1]}
        made |= {"setup_seconds": 0.5, "seconds": seconds[-1], "rays": 30, "frame_s": 1.0, "peak_gib": 1.0}
        return {**made, "split": {"train": 2, "test": 3}, **curve(seconds, psnr)}

    rows = {
        "a /4: mmpi-small; cpu": row("mmpi-small", "a", [10, 15, 20], [1, 10, 100]),
        "a /4: nerfacto; cpu": row("nerfacto", "a", [10, 15, 18], [10, 100, 1000]),
    }
    found = headline(rows)
    assert found["delta_at_end_db"] == 2 and found["delta_at_equal_time_db"] == pytest.approx(5)
    assert found["nerfacto_psnr_db"] == 18 and found["seconds_to_nerfacto_psnr"] == pytest.approx(10**1.6)
    quick = {"a /4: nerfacto (quick hashes); cpu": row("nerfacto (quick hashes)", "a", [10, 15, 17], [5, 50, 500])}
    both = headline(rows | quick)
    assert both["nerfacto_quick_hashes_delta_at_end_db"] == 3 and both["delta_at_end_db"] == 2
    assert "seconds_to_nerfacto_quick_hashes_psnr" in both and "seconds_to_nerfacto_psnr" in both
    rows["b /4: mmpi-small; cpu"] = row("mmpi-small", "b", [1, 2, 3], [1, 10, 100])
    assert headline(rows)["a_4_delta_at_end_db"] == 2 and headline(rows)["b_4_mmpi_small_psnr_db"] == 3
    content = {"rows": rows, "made": {k: "" for k in ("command", "processor", "threads", "torch", "commit", "date")}}
    lines = markdown(content).splitlines()
    assert "| mmpi-small, 300 steps | 15.00 | 17.39 | 18.89 |  |  |  | 20.00 (100 s) |" in lines


def test_methods_say_what_they_lack(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert METHODS["nerfacto"].why_not() is None and METHODS["mmpi"].why_not() is None
    assert "CUDA" in (METHODS["instant-ngp"].why_not() or "") and "CUDA" in (METHODS["splatfacto"].why_not() or "")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(methods.importlib.util, "find_spec", lambda name: None)
    assert METHODS["splatfacto"].why_not() == "the module gsplat is not installed"
    with pytest.raises(ValueError, match="nerfacto=1500"):
        command(Path(), Path(), steps=("nerfacto:3",))._lengths(METHODS["nerfacto"])
    with pytest.raises(ValueError, match="no method 'nerf'"):
        command(Path(), Path(), steps=("nerf=3",))._lengths(METHODS["nerfacto"])


def test_every_method_is_a_line_that_ns_train_takes(scene):
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    made = command(scene, Path("x"))
    for name in ("two-phase", "splatfacto", "poses alone"):
        request = made._request(scene, METHODS[name], 8, 5, Path("x"))
        config = tyro.cli(AnnotatedBaseConfigUnion, args=list(request.words))
        assert config.machine.seed == 5 and config.max_num_iterations == 8 and request.checks == (1, 2, 4, 6, 8)
        assert config.pipeline.datamanager.dataparser.downscale_factor == 1
        assert config.pipeline.datamanager.dataparser.load_3D_points == (name != "poses alone")
        if name == "splatfacto":
            assert request.whole_images and config.pipeline.model.camera_optimizer.mode == "off"
        elif name == "two-phase":
            assert config.pipeline.model.schedule.training == "two-phase"
