"""Which shapes kernels are tried with, what is remembered of it, and what is said. No kernel runs: plain torch stands
for them, wrong where a test wants it wrong."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import sysconfig
from types import SimpleNamespace

import pytest
import torch
from hand_made import make_mpi
from training_runs import ready, trainer_config
from triton_processes import needs_triton

from mmpi_ns.ops import dispatch, trial
from mmpi_ns.ops.layout import SMALL, Shapes
from mmpi_ns.ops.trial import Disagreement
from mmpi_ns.scene.plan import ScenePlan

WRONG_AT = {
    "nine MPIs": ("march", lambda layout, *_: len(layout.mpis) == 9),
    "heads by name": ("march", lambda layout, tables, rays, options: rays.heads is not None),
    "one MPI a ray": ("show_rays", lambda layout, tables, features, rays, options: rays.priorities is not None),
    "a picture of one MPI without a cube": ("show_rays", lambda layout, *_: layout.num_heads == 1),
    "eight channels": ("gather_taps", lambda values, *_: values.shape[1] == 8),
    "one channel": ("total_variation", lambda values, *_: values.shape[1] == 1),
    "no cube": ("total_variation", lambda values, table, rows, layout, *_: layout.cube is None),
}
RUN = Shapes((1, 9), cube=False)


@pytest.fixture
def kernels(monkeypatch):
    """Kernels that are plain torch, and off by a tenth where a condition on their arguments holds."""
    wrong, right = {}, dispatch.function

    def off_by_a_tenth(made):
        if isinstance(made, torch.Tensor):
            return 1.1 * made if made.is_floating_point() else made
        if dataclasses.is_dataclass(made):
            values = {f.name: off_by_a_tenth(getattr(made, f.name)) for f in dataclasses.fields(made)}
            return dataclasses.replace(made, **values)
        return type(made)(*map(off_by_a_tenth, made)) if isinstance(made, tuple) and hasattr(made, "_fields") else made

    def form(name, form):
        def kernel(*given):
            made = right(name, "reference")(*given)
            return off_by_a_tenth(made) if name in wrong and wrong[name](*given) else made

        return kernel if form == "gpu" else right(name, form)

    monkeypatch.setattr(dispatch, "function", form)
    return wrong


@pytest.mark.parametrize("where", WRONG_AT)
def test_a_kernel_that_is_wrong_for_shapes_of_the_run_is_noticed(kernels, where):
    name, condition = WRONG_AT[where]
    kernels[name] = lambda *given: False
    trial.run(name, "cpu", RUN)
    kernels[name] = condition
    with pytest.raises(Disagreement, match="not those of plain torch"):
        trial.run(name, "cpu", RUN)


def test_the_shapes_are_those_of_the_plan_at_hand(scene, plan_file, tmp_path):
    plans = [ScenePlan(tuple(make_mpi(str(k)) for k in range(n)), None, 0.05, 1.5) for n in (3, 1, 3)]
    assert Shapes.of(plans, False, 9) == Shapes((1, 3), False, False, 9)
    ready(trainer_config(scene, plan_file, tmp_path, 4))
    assert dispatch._shapes == Shapes((2,), True, True, 4)


@pytest.fixture
def gpu(monkeypatch, tmp_path):
    """A machine with an H100 and Triton, whose trials are noted: a function that tells them, and what to raise."""
    tried, error = [], []

    def run(name, device, shapes):
        tried.append(name)
        if error:
            raise error[0]

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    properties = SimpleNamespace(name="NVIDIA H100", major=9, minor=0)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: properties)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: properties.name)
    monkeypatch.setattr(dispatch, "_faults", {"Triton": None})
    monkeypatch.setattr(dispatch, "_shapes", SMALL)
    monkeypatch.setattr(dispatch, "_tries_afresh", False)
    monkeypatch.setattr(trial, "run", run)
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__="3.6.0"))
    dispatch._announce.cache_clear()

    def begin(shapes, **how):
        """A new process that trains a plan: what it tries."""
        tried.clear()
        for name in dispatch.operations():
            dispatch._faults.pop(name, None)
        dispatch.expect(shapes, **how)
        for name in ("march", "total_variation", "march"):
            dispatch.fault(name)
        return list(tried)

    yield SimpleNamespace(begin=begin, raises=error.append, properties=properties)
    dispatch._announce.cache_clear()


def test_kernels_are_tried_once_for_a_device_a_version_and_shapes(gpu, capsys):
    both = ["march", "total_variation"]
    assert gpu.begin(Shapes((3,))) == both
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("Compiling kernels for NVIDIA H100: about a minute, once.") == 1
    assert gpu.begin(Shapes((3,))) == [] and capsys.readouterr().out == ""
    assert gpu.begin(Shapes((4,))) == both
    assert gpu.begin(Shapes((3,)), afresh=True) == both, "mmpi-bench gpu believes nothing"
    capsys.readouterr()
    gpu.properties.name = "NVIDIA A100"
    assert gpu.begin(Shapes((5,))) == both and "A100" in capsys.readouterr().out
    gpu.properties.name = "NVIDIA H100"
    assert gpu.begin(Shapes((5,))) == both, "another device passed"


def test_what_failed_is_tried_again_by_the_next_process(gpu, capsys):
    gpu.raises(Disagreement("0.5 of its numbers are not those of plain torch"))
    assert gpu.begin(Shapes((3,))) == gpu.begin(Shapes((3,))) == ["march", "total_variation"]
    assert "Plain torch for march" in " ".join(capsys.readouterr().out.split())


def without_compiler(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))


def without_headers(monkeypatch, tmp_path):
    paths = sysconfig.get_paths
    monkeypatch.setattr(sysconfig, "get_paths", lambda *a, **k: {**paths(*a, **k), "include": str(tmp_path)})


@needs_triton
@pytest.mark.parametrize(
    ("lacks", "words"), [(without_compiler, "install gcc"), (without_headers, "Python.h is missing: install python")]
)
def test_without_a_compiler_or_headers_there_is_one_line(monkeypatch, tmp_path, capfd, gpu, lacks, words):
    """The errors are Triton's own, of the piece of C that starts kernels."""
    monkeypatch.delitem(sys.modules, "triton")
    monkeypatch.delenv("CC", raising=False)
    from triton.runtime.build import _build

    (tmp_path / "starter.c").write_text("#include <Python.h>\n")
    lacks(monkeypatch, tmp_path)
    try:
        _build("starter", str(tmp_path / "starter.c"), str(tmp_path), [], [], [], [])
    except (RuntimeError, subprocess.CalledProcessError) as error:
        gpu.raises(error)
    else:
        pytest.fail("Triton compiled it")
    capfd.readouterr()
    dispatch.expect(Shapes())
    names = [name for name, each in dispatch.operations().items() if "gpu" in each.compiled]
    assert len(names) == 4 and all(words in (dispatch.fault(name) or "") for name in names)
    said = " ".join(capfd.readouterr().out.split())
    assert said.count("Plain torch") == 1 and words.split(":")[0] in said
