"""A capture that each case may damage."""

from __future__ import annotations

import json
import shutil

import pytest
from tiny_scene import write_scene


@pytest.fixture(scope="session")
def whole_scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("whole") / "tiny")


@pytest.fixture
def data(whole_scene, tmp_path):
    """A tiny scene to be damaged; it has a COLMAP model."""
    return shutil.copytree(whole_scene, tmp_path / "data")


@pytest.fixture
def edit(data):
    """Changes the contents of transforms.json."""

    def change(how):
        meta = json.loads((data / "transforms.json").read_text())
        how(meta)
        (data / "transforms.json").write_text(json.dumps(meta))

    return change
