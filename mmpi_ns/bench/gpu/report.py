"""Page of ``mmpi-bench gpu``."""

from __future__ import annotations

from typing import Any

from mmpi_ns.bench.report import Row, page, table, title


def markdown(content: Row, head: Row) -> str:
    """The page: every table of every part."""
    parts = content["rows"]
    device = next((part["device"] for part in parts.values() if "device" in part), "no part has run")
    blocks = [f"On: {device}."]
    if content["rehearsal"]:
        blocks.append("**A rehearsal in miniature on a CPU: no number here is a measurement.**")
    for name, part in parts.items():
        blocks += [f"## {title(name)} ({part['wall_s']:.0f} s)"]
        blocks += [f"Not run: {part['not_run']}"] if "not_run" in part else []
        for said, rows in part.get("tables", {}).items():
            names = dict.fromkeys(k for row in rows.values() for k in row)
            columns = {"of": "{row}"}
            columns |= {n.replace("_", " "): lambda r, n=n: _number(r.get(n)) for n in names}
            blocks += [said, table(columns, ({"row": name, **row} for name, row in rows.items()))]
    numbers = ({"name": name, "value": _number(value)} for name, value in head.items())
    return page("On a GPU", content["made"], blocks, "## Headline", table({"": "{name}", "value": "{value}"}, numbers))


def _number(value: Any) -> str:
    if not isinstance(value, int | float):
        return "-" if value is None else str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
