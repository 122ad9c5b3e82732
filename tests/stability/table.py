"""Writes docs/results/stability.md: ``PYTHONPATH=tests:benchmarks python tests/stability/table.py``."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import torch
from report import Row, commit, page, processor, table, title
from stability import blending, geometry, merging, rays
from stability.cases import PRECISIONS, Case, Error

EVERY = [case for group in (geometry, blending, merging, rays) for case in group.cases()]
SAID = """\
Each cell is *error / bound* against exact arithmetic (float64, decimals where it cancels), relative to the
magnitudes that a number is made of; where nothing may be wrong it counts what is. Bounds are roundings times
condition: [docs/stability.md](../stability.md)."""


def row_of(case: Case) -> Row:
    """What a line of the table shows."""
    row: Row = {"group": case.group, "input": case.inputs, "expectation": case.expectation}
    found = {p.name: case.measure(p) for p in PRECISIONS}
    for name, outcome in found.items():
        row |= {f"{name}, value": shown(outcome.value), f"{name}, gradient": shown(outcome.gradient)}
    return row | {"": "pass" if all(outcome.holds for outcome in found.values()) else "**FAIL**"}


def shown(error: Error | None) -> str:
    if error is None:
        return "-"
    return f"{error.error:.1e} / {error.bound:.1e}" if error.bound else f"{error.error:.0f} wrong"


def main() -> None:
    rows = [row_of(case) for case in EVERY]
    columns = {name: lambda r, name=name: r[name] for name in rows[0] if name != "group"}
    blocks = [f"**{len(rows)} cases, {sum(r[''] != 'pass' for r in rows)} failed.**", SAID]
    for group in dict.fromkeys(r["group"] for r in rows):
        blocks += [f"## {title(group)}", table(columns, (r for r in rows if r["group"] == group))]
    made = {"command": "python tests/stability/table.py", "processor": processor(), "threads": torch.get_num_threads()}
    made |= {"torch": torch.__version__, "commit": commit(), "date": date.today().isoformat()}
    folder = Path(__file__).parents[2] / "docs/results"
    (folder / "stability.md").write_text(page("Stability on hard cases", made, blocks), encoding="utf-8")


if __name__ == "__main__":
    main()
