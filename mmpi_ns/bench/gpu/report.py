"""Markdown and figure of ``mmpi-bench gpu``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mmpi_ns.bench.report import Row, figure, page, table, title


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


def draw(path: Path, curves: dict[str, list[dict[str, float]]]) -> None:
    """PSNR against seconds, one line a method; nothing where none was trained."""
    if not curves:
        return
    with figure(path, 1, 1, (6, 4)) as ((axis,),):
        for name, curve in curves.items():
            axis.plot([max(p["seconds"], 0.1) for p in curve], [p["psnr"] for p in curve], marker="o", label=name)
        along = "seconds of training, placement and loading included"
        axis.set(xscale="log", xlabel=along, ylabel="PSNR of test views, dB")
