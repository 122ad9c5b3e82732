"""What all tests share: a small hand-made plan, and one thread."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest
import torch
from hand_made import make_mpi
from tiny_scene import write_scene

from mmpi_ns.ops import dispatch
from mmpi_ns.scene.plan import CubePlan, ScenePlan

# Of the processes that tests start too: test files run side by side, and threads that wait for each other spin.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Depths that tests find are no business of the user's cache.
USERS = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "mmpi_ns")
CACHE = tempfile.mkdtemp(prefix="mmpi-cache-")
os.environ["XDG_CACHE_HOME"] = CACHE
torch.set_num_threads(1)


def pytest_configure(config):
    """Kernels are compiled once, not once for each run: their names say of what and for which processor."""
    for source in (*_kept(config), USERS):
        _copy_kernels(source, Path(CACHE, "mmpi_ns"))


LONGEST = ("test_gpu", "test_commands", "test_window_training", "test_resume", "test_moving_masks")
"""Files whose few tests take minutes."""


def pytest_collection_modifyitems(items):
    """They start first, so that at the end no worker waits for another (xdist would start them last)."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


def pytest_unconfigure(config):
    for folder in _kept(config):
        _copy_kernels(Path(CACHE, "mmpi_ns"), folder)
    shutil.rmtree(CACHE, ignore_errors=True)


def _kept(config) -> list[Path]:
    """Where kernels stay from one run to the next; nowhere where pytest is told to keep nothing."""
    return [config.cache.mkdir("kernels")] if hasattr(config, "cache") else []


def _copy_kernels(source: Path, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for path in source.glob("kernels-*.so"):
        if not (target / path.name).exists():
            unfinished = target / f"{path.name}.{os.getpid()}"
            shutil.copyfile(path, unfinished)
            unfinished.rename(target / path.name)


@pytest.fixture(params=["torch", "native"])
def form(request):
    """Operations run in plain torch, and compiled."""
    with dispatch.chosen(request.param):
        yield


@pytest.fixture
def three_threads():
    """Torch, and with it the compiled operations, share their work among three threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def plan() -> ScenePlan:
    """Two MPIs that overlap, and a cube."""
    side = make_mpi("left", (2.0, 0.0, 3.0), ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)), near=2.0)
    cube = CubePlan((-1.0, -1.0, 2.0), (1.0, 1.0, 5.0), (7, 5, 5))
    return ScenePlan((make_mpi(), side), cube, ray_near=0.05, content_near=1.5)


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """Folder of the tiny scene."""
    return write_scene(tmp_path_factory.mktemp("scene") / "tiny")


@pytest.fixture(scope="session")
def plan_file(scene, tmp_path_factory):
    """A plan of two overlapping MPIs and a cube for the tiny scene."""
    from training_runs import write_plan

    return write_plan(scene, tmp_path_factory.mktemp("plan") / "plan.json", with_cube=True)
