"""A capture that each case may damage."""

from __future__ import annotations

import shutil
from functools import partial

import pytest
import tiny_scene


@pytest.fixture(scope="session")
def whole_scene(tmp_path_factory):
    return tiny_scene.write_scene(tmp_path_factory.mktemp("whole") / "tiny")


@pytest.fixture
def data(whole_scene, tmp_path):
    """A tiny scene to be damaged; it has a COLMAP model."""
    return shutil.copytree(whole_scene, tmp_path / "data")


@pytest.fixture
def edit(data):
    """Changes the contents of transforms.json."""

    return partial(tiny_scene.edit, data)
