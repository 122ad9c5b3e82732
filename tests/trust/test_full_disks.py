"""A full disk ends a command in one sentence where nerfstudio writes, too."""

from __future__ import annotations

from pathlib import Path

import pytest
from forked import run, train

FULL = Path("/dev/full")
"""A device of Linux on which nothing can be written."""
pytestmark = pytest.mark.skipif(not FULL.exists(), reason="no device that is always full")


def full(path):
    """Makes a file that nothing can be written to."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(FULL)
    return path


def test_a_disk_that_is_full_when_nerfstudio_writes_is_told(whole_scene, tmp_path):
    folder = tmp_path / "tiny/mmpi-small/run"
    config = full(folder / "config.yml")
    said = train(whole_scene, tmp_path).sentence
    assert "could not be written (No space left on device)" in said and "make room" in said
    config.unlink()
    assert train(whole_scene, tmp_path).status == 0  # the lock went with the process
    output = full(tmp_path / "eval.json")
    said = run("ns-eval", "--load-config", folder / "config.yml", "--output-path", output).sentence
    assert "could not be written (No space left on device)" in said
