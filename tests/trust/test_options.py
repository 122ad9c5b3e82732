"""Options that cannot be used are named before anything is written."""

from __future__ import annotations

import copy
import math

import pytest
from forked import run, train

from mmpi_ns.config import mmpi_kitti
from mmpi_ns.training.options import check_run
from mmpi_ns.utils.errors import InputError

NAN, INF = math.nan, math.inf
P, M, D = "pipeline__model__placement__", "pipeline__model__", "pipeline__datamanager__"

REFUSED = {
    "max_num_iterations": -1,
    "machine__seed": 10**30,
    "machine__num_devices": 2,
    "machine__device_type": "mps",
    D + "train_num_rays_per_batch": 0,
    D + "resident_pixels": NAN,
    P + "texel_pixels": INF,
    P + "max_planes": 1,
    P + "faces": ("up",),
    M + "colour__hidden_width": -1,
    M + "sampling__cube_alpha": 2.0,
    M + "schedule__growth_shares": (0.5, 2.0),
    M + "loss__distortion": NAN,
}


def option_of(name):
    return "--" + name.replace("__", ".").replace("_", "-")


@pytest.mark.parametrize("name", REFUSED)
def test_an_option_out_of_range_is_named(whole_scene, tmp_path, name):
    said = train(whole_scene, tmp_path / "out", **{name: REFUSED[name]}).sentence
    assert option_of(name) in said and not (tmp_path / "out").exists()


def test_a_method_of_the_paper_needs_a_number_of_steps():
    config = copy.deepcopy(mmpi_kitti.config)
    check_run(config)
    config.max_num_iterations = 0
    with pytest.raises(InputError, match="mmpi-kitti has no number of steps"):
        check_run(config)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"load_step": 3}, ["--load-step", "--load-dir"]),
        ({"mixed_precision": True}, ["--mixed-precision", "CPU"]),
    ],
)
def test_options_that_say_nothing_together_are_refused(whole_scene, tmp_path, changes, words):
    said = train(whole_scene, tmp_path, **changes).sentence
    assert all(word in said for word in words), said


OTHER_COMMANDS = [
    *(("mmpi-scene street {out}", option, value) for option, value in (
        ("--width", "0"), ("--length", "nan"), ("--outliers", "2"),
    )),
]  # fmt: skip


@pytest.mark.parametrize(("command", "option", "value"), OTHER_COMMANDS)
def test_other_commands_name_the_option_that_cannot_be_used(tmp_path, command, option, value):
    words = command.format(out=tmp_path / "out").split()
    assert run(*words, option, value).sentence.startswith(f"{option} must be")
    assert not (tmp_path / "out").exists()


def test_seeds_of_the_machine_are_those_of_our_draws(whole_scene, tmp_path):
    import torch

    for name, seed in (("a", 1), ("b", 2), ("c", 1)):
        assert train(whole_scene, tmp_path, timestamp=name, machine__seed=seed).status == 0
    a, b, c = (
        torch.load(tmp_path / "tiny/mmpi-small" / n / "nerfstudio_models/step-000000002.ckpt", weights_only=True)
        for n in "abc"
    )
    key = "_model.field.features"
    assert torch.equal(a["pipeline"][key], c["pipeline"][key])
    assert not torch.equal(a["pipeline"][key], b["pipeline"][key])


def test_the_viewer_listens_on_this_machine_alone():
    from mmpi_ns import config

    for name in ("mmpi", "mmpi_small", "mmpi_kitti", "mmpi_scannet", "mmpi_scannet_short"):
        assert getattr(config, name).config.viewer.websocket_host == "127.0.0.1"
