"""Writes which commit every table of docs/results was made at into its README: python benchmarks/ages.py."""

from __future__ import annotations

import json
from pathlib import Path

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results"
BEGIN, END = "<!-- ages -->", "<!-- /ages -->"


def ages(folder: Path) -> str:
    """A sentence with the tables of each commit, newest first; of a suite, whose rows have commits, the oldest."""
    tables: dict[tuple[str, str], list[str]] = {}
    for path in folder.rglob("*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        rows = [row for row in content.get("rows", {}).values() if isinstance(row, dict)]
        made = content["made"] if "made" in content else min(rows, key=lambda row: row.get("date", ""), default={})
        when = made.get("date", "no date"), made.get("commit", "unknown")
        tables.setdefault(when, []).append(str(path.relative_to(folder).with_suffix("")))
    parts = (f"{commit} ({date}): {', '.join(sorted(names))}" for (date, commit), names in sorted(tables.items())[::-1])
    return f"**Age of the tables**, by commit: {'; '.join(parts)}."


def main() -> None:
    page = RESULTS / "README.md"
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    page.write_text(f"{before}{BEGIN}\n{ages(RESULTS)}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
