"""What all benchmarks share: options, provenance, rows that are kept, and one way to write a table.

A new benchmark is a file of ``benchmarks/`` with a dataclass that extends ``Bench`` and keeps its rows in a ``Report``.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shlex
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields
from datetime import date
from pathlib import Path
from typing import Any, ClassVar

import torch

import mmpi_ns
import mmpi_priors
import mmpi_scene
from mmpi_ns.utils.machine import processor
from mmpi_ns.utils.values import Number, check_options

Row = dict[str, Any]
Cell = str | Callable[[Row], Any]
"""How a column shows a row: a format string over the row's names, or a function of the row."""


def commit() -> str:
    """Short hash of the commit that the code is checked out at; "unknown" where it is installed."""
    words = ["git", "-C", str(Path(mmpi_ns.__file__).resolve().parent), "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


@dataclass(kw_only=True)
class Bench(ABC):
    """Options of every benchmark."""

    output: Path = Path("docs/results")
    """Where the table goes, as JSON and Markdown, and its figure."""
    work: Path = Path("outputs")
    """Runs and their logs go to a folder in this, named as the command."""
    threads: int = 0
    """0 for all cores."""
    name: ClassVar[str]
    """Of the command and of its files."""

    def main(self) -> None:
        """Measures, once the numbers among the options are known to be counts."""
        counts = {f.name: Number(0, whole=True) for f in fields(self) if type(getattr(self, f.name)) is int}
        check_options(self, counts, "--")
        self.run()

    @abstractmethod
    def run(self) -> None:
        """Measures, and writes the table."""

    @property
    def cores(self) -> int:
        return self.threads or os.cpu_count() or 1

    @property
    def folder(self) -> Path:
        """Of runs and logs."""
        return self.work / self.name

    def key(self, *without: str) -> str:
        """Of all that a row depends on: the sources and the settings, but for those named."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("output", "work", *without)}
        own["threads"] = self.cores
        words = (f"{k} {v.resolve().name if isinstance(v, Path) else v}" for k, v in own.items())
        return f"{fingerprint()} {', '.join(words)}"


class Report:
    """The rows of one table, written after each. Rows that an earlier run finished are kept where its key is this one.

    Args:
        bench: whose.
        key: of what all rows depend on; None keeps none.
        file: name of the files, without ending; the command's unless given.
    """

    def __init__(self, bench: Bench, key: str | None = "", file: str = "") -> None:
        self.path = bench.output / f"{file or bench.name}.json"
        before = read_json(self.path)
        kept = before if key is not None and before.get("key", "") == key else {}
        self.content: Row = {"headline": {}, "made": stamp(bench), "key": key} | {"rows": kept.get("rows", {})}
        self.kept = kept
        """All of the earlier file, where its key is this one."""

    @property
    def rows(self) -> dict[str, Row]:
        return self.content["rows"]

    def row(self, name: str, make: Callable[[], Row], needed: bool = True) -> Row:
        """The row of this name, made now unless there is one that did run.

        Raises:
            ValueError: it did not run, and the table is nothing without it.
        """
        if "not_run" in self.rows.get(name, {"not_run": ""}):
            made = make()
            if needed and "not_run" in made:
                raise ValueError(f"{name}: {made['not_run']}")
            if self.kept:  # another run may have added rows meanwhile
                self.content["rows"] = read_json(self.path).get("rows", {}) | self.rows
            self.rows[name] = made
            self.save()
            self.kept = self.content
        return self.rows[name]

    def save(self) -> None:
        write_json(self.path, self.content)

    def finish(self, headline: Row, page: str, draw: Callable[[Path], None] | None = None) -> None:
        """Writes the named numbers of the headline (those that are finite), the page and the figure."""
        numbers = {k: v for k, v in headline.items() if isinstance(v, int | float) and math.isfinite(v)}
        self.content["headline"] = numbers
        self.save()
        self.path.with_suffix(".md").write_text(page, encoding="utf-8")
        if draw is not None:
            draw(self.path.with_suffix(".png"))


# Pages ---------------------------------------------------------------------------------------------------


def page(title: str, made: Row, *blocks: str | list[str]) -> str:
    """A Markdown page: title, provenance, and blocks (or lists of them) parted by empty lines."""
    flat = [b for block in blocks for b in ([block] if isinstance(block, str) else block) if b]
    return "\n\n".join([f"# {title}", stamp_line(made), *flat]) + "\n"


def table(columns: Mapping[str, Cell], rows: Iterable[Row]) -> str:
    """A Markdown table: columns by heading, a line for each row."""
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    lines += [f"| {' | '.join(cell(column, row) for column in columns.values())} |" for row in rows]
    return "\n".join(lines)


def cell(column: Cell, row: Row) -> str:
    """Text of one column of a row."""
    return column.format(**row) if isinstance(column, str) else str(column(row))


def slug(text: str, between: str = "_") -> str:
    """The text in small letters and digits, for names of files and numbers."""
    return re.sub(r"[^a-z0-9]+", between, text.lower()).strip(between)


def title(text: str) -> str:
    """With a capital, the rest as it is."""
    return text[:1].upper() + text[1:]


# Provenance ----------------------------------------------------------------------------------------------------------


def fingerprint() -> str:
    """Hash of torch's version and of the sources of the packages and the benchmarks."""
    files = (mmpi_ns.__file__, mmpi_priors.__file__, mmpi_scene.__file__, __file__)
    folders = [Path(file).resolve().parent for file in files]
    digest = hashlib.sha256(torch.__version__.encode())
    for path in sorted(p for folder in folders for p in folder.rglob("*") if p.suffix in (".py", ".cpp", ".h")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def command_of(bench: Bench) -> str:
    """The command line that makes these settings: what differs from the defaults."""
    words = ["python", f"benchmarks/{bench.name}.py"]
    for f in fields(bench):
        value = getattr(bench, f.name)
        if value == (f.default_factory() if f.default_factory is not MISSING else f.default):
            continue
        flag = f.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{flag}")
        else:
            words += [f"--{flag}", *(_word(v) for v in (value if isinstance(value, tuple) else (value,)))]
    return shlex.join(words)


def _word(value: Any) -> str:
    """Where a folder lies on this machine is of no interest to others, its name is."""
    return value.name if isinstance(value, Path) and value.is_absolute() else str(value)


def stamp(bench: Bench) -> Row:
    """Provenance of a run that starts now."""
    made = {"command": command_of(bench), "processor": processor(), "threads": bench.cores}
    return made | {"torch": torch.__version__, "commit": commit(), "date": date.today().isoformat()}


def stamp_line(made: Row) -> str:
    """The same as a sentence for a table."""
    return (
        f"Made by `{made['command']}` on {made['processor']} ({made['threads']} thread(s), torch {made['torch']}), "
        f"commit {made['commit']}, {made['date']}."
    )


def read_json(path: Path) -> Row:
    """What an earlier run left; empty where there is nothing."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def write_json(path: Path, content: Row) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, path)
