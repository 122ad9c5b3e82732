"""``--version`` of every command: the one in pyproject.toml, as installed."""

from __future__ import annotations

import sys
from importlib.metadata import version


def say_version(command: str) -> None:
    """Ends the command with its name and version where ``--version`` is the first word given."""
    if sys.argv[1:2] == ["--version"]:
        print(f"{command} {version('mmpi-ns')}")
        sys.exit()
