"""The version is one: of the package, of every command, of the changelog and of the citation."""

from __future__ import annotations

import re
import sys
from importlib.metadata import entry_points, version
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYPROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
VERSION = re.findall(r'^version = "(.*)"', PYPROJECT, re.MULTILINE)[0]
COMMANDS = re.findall(r'^(mmpi-\w+) = "mmpi_\w+\.(?:__main__|scripts)', PYPROJECT, re.MULTILINE)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_the_version_of_pyproject(name, monkeypatch, capsys):
    (command,) = entry_points(group="console_scripts", name=name)
    monkeypatch.setattr(sys, "argv", [name, "--version"])
    with pytest.raises(SystemExit) as end:
        command.load()()
    assert (capsys.readouterr().out, end.value.code) == (f"{name} {VERSION}\n", None)


def test_changelog_and_citation_are_of_this_version():
    assert len(COMMANDS) == 4 and version("mmpi-ns") == VERSION
    newest = re.findall(r"^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)[0]
    cited = re.findall(r"^version: (\S+)", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert [newest, *cited] == [VERSION, VERSION]
