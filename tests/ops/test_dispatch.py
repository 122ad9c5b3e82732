"""Which form of an operation runs, and what happens where the compiled ones are not available."""

from __future__ import annotations

import importlib
import inspect
import math
import os
import subprocess
from pathlib import Path

import pytest
import torch
from compiled import compiled  # noqa: F401
from kernel_cases import CASES
from random_fields import bundle, random_field, random_rays, render

from mmpi_ns.ops import build, dispatch


@pytest.fixture(scope="module")
def operations():
    """All of them, by name."""
    for ops in ("mmpi_ns.ops", "mmpi_priors.ops", "mmpi_show.ops"):
        for path in Path(str(importlib.import_module(ops).__file__)).parent.glob("*/__init__.py"):
            importlib.import_module(f"{ops}.{path.parent.name}")
    return dispatch.OPERATIONS


def test_every_operation_with_a_gpu_form_has_cases(operations):
    assert set(CASES) == {name for name, each in operations.items() if "gpu" in each.compiled}


def test_all_forms_of_an_operation_take_the_same_arguments(operations):
    for name, each in operations.items():
        wanted = [(p.name, p.default) for p in each.signature.parameters.values()]
        for form in each.compiled:
            made = dispatch.function(name, form)
            if getattr(made, "func", None) != each._in_cpp:
                given = inspect.signature(made).parameters.values()
                assert [(p.name, p.default) for p in given] == wanted, (name, form)


@pytest.fixture
def unbuilt(monkeypatch, tmp_path):
    """A machine on which nothing has been compiled yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    build.library.cache_clear()
    dispatch.fault.cache_clear()
    yield tmp_path
    build.library.cache_clear()
    dispatch.fault.cache_clear()


def test_without_a_compiler_plain_torch_runs_and_the_log_says_so(monkeypatch, unbuilt, capsys):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(build.shutil, "which", lambda name: None)
    field = random_field(2, seed=1)
    rays = bundle(*random_rays(field.plan, 10, seed=1))
    assert math.isfinite(render(field, rays).rgb.sum()) and dispatch.form_of("march", torch.zeros(1)) == "reference"
    render(field, rays)
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("no C++ compiler (g++ or clang++) is installed") == 1
    with pytest.raises(ValueError, match="no C\\+\\+ compiler"):
        dispatch.choose("native")


def test_a_compiler_that_fails_is_named(monkeypatch, unbuilt, capsys):
    broken = unbuilt / "broken-compiler"
    broken.write_text("#!/bin/sh\necho 'no such flag' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CXX", str(broken))
    assert dispatch.form_of("march", torch.zeros(1)) == "reference"
    said = "".join(capsys.readouterr().out.split())
    assert "broken-compiler" in said and "nosuchflag" in said
    assert not list(unbuilt.glob("mmpi_ns/*.so"))


def test_what_was_compiled_is_used_again(monkeypatch):
    assert dispatch.form_of("march", torch.zeros(1)) == "cpu"
    assert list(Path(os.environ["XDG_CACHE_HOME"], "mmpi_ns").glob("kernels-*.so"))
    build.library.cache_clear()
    dispatch.fault.cache_clear()
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: pytest.fail("compiled twice"))
    assert dispatch.form_of("march", torch.zeros(1)) == "cpu"


def test_other_precisions_and_the_users_choice_take_the_plain_path():
    assert dispatch.form_of("march", torch.zeros(1, dtype=torch.float64)) == "reference"
    dispatch.choose("torch")
    assert dispatch.form_of("march", torch.zeros(1)) == "reference"
