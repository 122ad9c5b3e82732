"""``mmpi-bench``: the tables in docs/results, each reproduced by one command."""

from __future__ import annotations

import ast
import sys
from dataclasses import fields
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from mmpi_ns.scripts.command import say_version
from mmpi_ns.utils.values import Number, check_options

COUNT = Number(0, whole=True)
COMMANDS = {
    "train": "quality.train",
    "score": "quality.score",
    "render": "speed.render",
    "speed": "speed.against_peers",
    "ops": "speed.ops",
    "roads": "speed.roads",
    "processes": "speed.processes",
    "ablate": "quality.ablate",
    "gpu": "gpu.command",
    "accuracy": "quality.accuracy",
    "results": "quality.results",
    "prepare": "quality.prepare",
    "poses": "quality.poses",
}
"""Module below mmpi_ns.bench with the command, as a class of its name. Only the requested one is imported."""


def _purpose(module: str) -> str:
    """First line of a module's docstring, read without importing it."""
    origin = getattr(find_spec(f"mmpi_ns.bench.{module}"), "origin", None)
    source = Path(origin).read_text(encoding="utf-8") if origin else ""
    return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0].rpartition("``: ")[2]


def entrypoint() -> None:
    """The command ``mmpi-bench``; an error is one sentence and exit status 1."""
    say_version("mmpi-bench")
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name not in COMMANDS:
        print("usage: mmpi-bench COMMAND [OPTIONS] (mmpi-bench COMMAND --help)\n")
        print("\n".join(f"  {command:10} {_purpose(module)}" for command, module in COMMANDS.items()))
        sys.exit(0 if name in ("-h", "--help") else f"mmpi-bench: there is no command {name!r}.")
    import tyro

    measure = getattr(import_module(f"mmpi_ns.bench.{COMMANDS[name]}"), name.capitalize())
    command = tyro.cli(measure, prog=f"mmpi-bench {name}", args=sys.argv[2:])
    try:
        counts = {f.name: COUNT for f in fields(command) if type(getattr(command, f.name)) is int}
        check_options(command, counts, "--")
        command.run()
    except (ValueError, OSError) as error:
        sys.exit(f"mmpi-bench: {error}")


if __name__ == "__main__":
    entrypoint()
