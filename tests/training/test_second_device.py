"""Whether a run mixes devices: trained, tested and given details on a device that is not the CPU, without a GPU."""

from __future__ import annotations

import re

import pytest
from triton_processes import HERE, python


@pytest.mark.commands
def test_nothing_of_a_run_mixes_devices(tmp_path):
    """Every run on a GPU ended in a traceback once, and no test saw it."""
    words = ("-m", "pytest", "-p", "no:cacheprovider", str(HERE / "second_device_runs.py"))
    ended = python(*words, BUILD=str(tmp_path))
    assert ended.returncode == 0, ended.stdout[-6000:] + ended.stderr[-2000:]
    assert re.search(r"4 passed", ended.stdout) and "skipped" not in ended.stdout
