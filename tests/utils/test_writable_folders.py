"""Folders that results are written to, and files that cannot be written."""

from __future__ import annotations

import errno

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


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path):
    def fill(path):
        path.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(WriteError, match=r"a\.bin could not be written .*No space left.*earlier files are untouched"):
        files.write_atomically(tmp_path / "a.bin", fill)
    assert not list(tmp_path.iterdir())
