"""The matrix of captures runs commands on what it wrote, with one thread."""

from __future__ import annotations

import sys
from pathlib import Path

import matrix


def test_a_relative_folder_is_found_by_the_commands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = []
    stopped = {"outcome": "stopped", "seconds": 0.0, "gib": 0.0}
    monkeypatch.setattr(matrix, "run_command", lambda command, folder: asked.append(command) or stopped)
    matrix.Matrix(Path("folder"), most=0.2, output=Path("matrix.md")).main()
    data = Path(asked[0][asked[0].index("--data") + 1])
    assert data == tmp_path / "folder/capture/data"


def test_a_command_has_the_one_thread_that_the_page_tells_of(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    asks = "import os, sys; sys.exit(f'{sys.argv[1]}: ' + os.environ['OMP_NUM_THREADS'])"
    name = Path(sys.executable).name
    assert matrix.run_command([name, "-c", asks, name], tmp_path)["outcome"] == f"{name}: 1"
