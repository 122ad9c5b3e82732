"""The Triton kernels without a GPU: interpreted in a process of their own, compiled for one that is not there."""

from __future__ import annotations

import re
import sys
from types import SimpleNamespace

import pytest
import torch
from gpu_parts import interpret
from random_fields import bundle, random_field, random_rays, render
from triton_processes import HERE, needs_triton, python

from mmpi_ns.ops import dispatch


@needs_triton
def test_kernels_by_the_interpreter():
    """The variable must be set before Triton is imported, so these tests have a process of their own."""
    file = str(HERE / "ops" / "interpreted.py")
    actual = python("-m", "pytest", "-p", "no:cacheprovider", file, TRITON_INTERPRET="1")
    assert actual.returncode == 0, actual.stdout[-6000:] + actual.stderr[-2000:]
    passed = re.search(r"(\d+) passed", actual.stdout)
    assert passed and int(passed[1]) > 30 and "skipped" not in actual.stdout, actual.stdout[-500:]


@needs_triton
@pytest.mark.parametrize("architecture", [75, 90])
def test_kernels_compile_without_spilling_registers(monkeypatch, architecture):
    """For the oldest and the newest GPU. The interpreter takes what the compiler does not: types, shapes, control
    flow."""
    from triton_compiling import all_launches, largest_launches, spills

    launches = largest_launches(all_launches(monkeypatch.setattr))
    assert {"march_kernel", "render_kernel", "gather_kernel", "variation_kernel"} < set(launches)
    for name, launch in launches.items():
        compiled = launch.compiled(architecture)
        assert compiled.asm["cubin"] and (architecture < 90 or not spills(compiled)), (name, launch.constants)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_kernels_on_a_gpu():
    from kernel_checks import run_checks

    actual = run_checks("cuda", rehearse=False)
    assert actual["failed"] == 0 and len(actual["checks"]) > 30, [c for c in actual["checks"] if not c["ok"]]


def test_importing_the_package_imports_no_kernel():
    """And where Triton is missing, or what a bare GPU machine lacks, all of it imports."""
    code = (
        "import sys\n"
        "sys.modules |= dict.fromkeys(('triton', 'open3d', 'pymeshlab', 'pycolmap', 'wandb', 'comet_ml'))\n"
        "import nerfstudio.configs.method_configs, mmpi_ns.training.trainer, mmpi_ns.data.datamanager\n"
        "assert not [m for m in sys.modules if m.startswith('mmpi_ns.ops') and 'gpu' in m]"
    )
    actual = python("-c", code)
    assert actual.returncode == 0, actual.stderr


@pytest.fixture
def no_triton(monkeypatch):
    """A machine with a GPU (whose tensors are the CPU's) and without Triton."""
    dispatch.function.cache_clear()
    dispatch.fault.cache_clear()
    monkeypatch.setattr(dispatch, "_chosen", "auto")
    for name in [m for m in sys.modules if m.startswith("mmpi_ns.ops") and "gpu" in m]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "triton", None)
    yield
    dispatch.function.cache_clear()
    dispatch.fault.cache_clear()


def test_without_triton_plain_torch_runs_and_the_log_says_so(monkeypatch, no_triton, capsys):
    with pytest.raises(ValueError, match="TRITON_INTERPRET=1"):
        interpret(True)
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    with pytest.raises(ValueError, match="Triton is not available"):
        interpret(True)
    assert not dispatch.interpreting
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("Plain torch instead of the compiled operations") == 1 and "Triton cannot be imported" in said
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with pytest.raises(ValueError, match="Triton cannot be imported"):
        dispatch.choose("native")
    dispatch.choose("auto")
    field = random_field(2, seed=1)
    assert torch.isfinite(render(field, bundle(*random_rays(field.plan, 5, seed=1))).rgb).all()


@pytest.mark.parametrize(("version", "accepted"), [("3.0.0", False), ("3.1.0", True), ("3.10.0+git", True)])
def test_a_triton_too_old_for_the_kernels_is_refused_in_one_sentence(monkeypatch, capsys, request, version, accepted):
    dispatch.fault.cache_clear()
    request.addfinalizer(dispatch.fault.cache_clear)
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__=version))
    assert (dispatch.fault("Triton") is None) == accepted
    said = " ".join(capsys.readouterr().out.split())
    assert accepted == (not said) and (accepted or (f"Triton {version} is too old" in said and "torch 2.5" in said))


def test_on_a_cpu_nothing_takes_the_gpus_kernels():
    assert all(dispatch.form_of(name, torch.zeros(1)) != "gpu" for name in dispatch.OPERATIONS)
