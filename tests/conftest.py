"""What all tests share: a small hand-made plan, one thread, and hypothesis settings that suit a busy machine."""

from __future__ import annotations

import os
import tempfile

import hypothesis
import pytest
import torch
from hand_made import make_mpi
from tiny_scene import write_scene

from mmpi_ns.scene.plan import CubePlan, ScenePlan

# Of the processes that tests start too: test files run side by side, and threads that wait for each other spin.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Depths that tests find are no business of the user's cache.
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="mmpi-cache-")
torch.set_num_threads(1)
hypothesis.settings.register_profile("mmpi", deadline=None, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("mmpi")


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
