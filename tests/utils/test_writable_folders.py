"""Folders that results are written to."""

from __future__ import annotations

import pytest

from mmpi_ns.utils import files
from mmpi_ns.utils.errors import WriteError


def test_a_folder_that_is_there_and_cannot_be_written_is_named(tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    files.make_writable(tmp_path / "new", "--output")
    assert (tmp_path / "new").is_dir() and not list((tmp_path / "new").iterdir())
    monkeypatch.setattr(files, "TemporaryFile", refuse)  # root may write everywhere
    with pytest.raises(WriteError, match=r"new cannot be written \(.*Permission denied\): choose another --output"):
        files.make_writable(tmp_path / "new", "--output")
