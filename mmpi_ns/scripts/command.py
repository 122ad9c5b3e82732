"""Shared by all commands: ``--version``, and errors as one sentence."""

from __future__ import annotations

import signal
import sys
from importlib.metadata import version
from typing import Any

import tyro


def print_version(name: str) -> None:
    """Prints the name and the version of pyproject.toml and ends the command if ``--version`` is its first argument."""
    if sys.argv[1:2] == ["--version"]:
        print(f"{name} {version('mmpi-ns')}")
        sys.exit()


def run(name: str, command: Any, **how: Any) -> int:
    """Reads the options of a command, a type that tyro builds from the arguments, runs its ``main`` and returns the
    exit status. ``how`` is for tyro."""
    print_version(name)
    try:
        tyro.cli(command, **{"prog": name, **how}).main()
    except (ValueError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{name}: Interrupted.", file=sys.stderr)
        return 128 + signal.SIGINT
    return 0
