"""``mmpi-bench stability``: hard inputs against exact arithmetic, and trainings with absurd settings."""

from __future__ import annotations

import math
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mmpi_ns.bench.provenance import fingerprint, read_json, stamp, stamp_line, write_json
from mmpi_ns.bench.stability import blending as cases_blending
from mmpi_ns.bench.stability import geometry as cases_geometry
from mmpi_ns.bench.stability import merging as cases_merging
from mmpi_ns.bench.stability import rays as cases_rays
from mmpi_ns.bench.stability.cases import PRECISIONS, Case, Error, Precision

GROUPS = (cases_geometry, cases_blending, cases_merging, cases_rays)


@dataclass
class Stability:
    """Hard cases: error of values and gradients against float64, with bounds; and absurd trainings.

    Ends with status 1 where a case fails. Started again it goes on: cases that were measured with the same sources, and
    trainings that are done, are taken from stability.json. Remove that to start afresh.
    """

    output: Path = Path("docs/results")
    """Where stability.json, stability.md and stability.png go."""
    training: bool = True
    """Train with absurd settings as well."""
    steps: int = 2000
    """Steps of each of those trainings."""
    work: Path = Path("outputs/stability")
    """Where those trainings go."""
    only: str = ""
    """Run only the cases (or trainings) whose group and input contain this, and write nothing."""

    def run(self) -> None:
        made, path = stamp("stability", self), self.output / "stability.json"
        before = {} if self.only else read_json(path)
        content: dict[str, Any] = {"headline": {}, "made": made, "sources": fingerprint(), "rows": []}
        content["trainings"] = before.get("trainings", {})
        known = before.get("rows", []) if before.get("sources") == content["sources"] else []

        def save() -> None:
            content["headline"] = headline(content["rows"], content["trainings"])
            if not self.only:
                write_json(path, content)

        chosen = [c for c in all_cases() if self.only in f"{c.group}: {c.inputs}"]
        run_cases(chosen, known, content["rows"], save)
        if self.training:
            self._train(content["trainings"], save)
        save()
        if not self.only:
            (self.output / "stability.md").write_text(table(content), encoding="utf-8")
            draw(self.output / "stability.png", content["rows"])
        print(content["headline"])
        if content["headline"]["failed"]:
            raise SystemExit("mmpi-bench: a case fails its bound; see the lines above that say FAIL.")

    def _train(self, done: dict[str, Any], save: Callable[[], None]) -> None:
        from mmpi_ns.bench.stability.absurd import ABSURDITIES, train

        for number, absurdity in enumerate(ABSURDITIES, 1):
            if self.only not in f"training: {absurdity.name}":
                continue
            if done.get(absurdity.name, {}).get("steps") != self.steps:
                done[absurdity.name] = train(absurdity, self.work, self.steps)
                save()
            row = done[absurdity.name]
            verdict = "ok" if row["ok"] else "FAIL"
            print(f"[training {number}/{len(ABSURDITIES)}] {verdict} {absurdity.name}: {row['outcome']}", flush=True)


def all_cases() -> list[Case]:
    """Every case, in the order of the table."""
    return [case for group in GROUPS for case in group.cases()]


def run_cases(
    chosen: list[Case], known: list[dict[str, Any]], rows: list[dict[str, Any]], save: Callable[[], None]
) -> None:
    """Measures each case under every arithmetic into ``rows``; those among ``known`` are taken from there."""
    by_name = {(row["group"], row["inputs"]): row for row in known}
    for number, case in enumerate(chosen, 1):
        start = time.perf_counter()
        row = by_name.get((case.group, case.inputs))
        if row is None:
            paths = {p.name: _measure(case, p) for p in PRECISIONS}
            row = {"group": case.group, "inputs": case.inputs, "expectation": case.expectation, "paths": paths}
            row["ok"] = all(path["ok"] for path in paths.values())
            row["seconds"] = time.perf_counter() - start
        rows.append(row)
        save()
        said = "ok  " if row["ok"] else "FAIL"
        print(f"[{number}/{len(chosen)}] {said} {case.group}: {case.inputs} ({row['seconds']:.1f} s)", flush=True)


def headline(rows: list[dict[str, Any]], trainings: dict[str, Any]) -> dict[str, Any]:
    """How many cases there are and how many fail; trainings among them."""
    every = [*rows, *trainings.values()]
    used = [use(cell) for row in rows for path in row["paths"].values() for cell in (path["value"], path["gradient"])]
    return {
        "cases": len(every),
        "failed": sum(not row["ok"] for row in every),
        "input_cases": len(rows),
        "trainings": len(trainings),
        "largest_share_of_a_bound": max((u for u in used if u is not None), default=0.0),
    }


def _measure(case: Case, precision: Precision) -> dict[str, Any]:
    try:
        outcome = case.measure(precision)
    except Exception as error:  # whatever a hard input makes a kernel raise is a result, not the end of the table
        traceback.print_exc(limit=-3)
        said = f"{type(error).__name__}: {error}"
        return {"value": {"error": None, "bound": 0.0}, "gradient": None, "ok": False, "raised": said}
    return {"value": _cell(outcome.value), "gradient": _cell(outcome.gradient), "ok": outcome.holds}


def _cell(error: Error | None) -> dict[str, Any] | None:
    """JSON knows no infinity: a result that is not finite has no error."""
    if error is None:
        return None
    return {"error": error.error if math.isfinite(error.error) else None, "bound": error.bound}


def use(cell: dict[str, Any] | None) -> float | None:
    """Share of its bound that an error uses; None where there is no bound to share (nothing may be wrong there)."""
    if cell is None or cell["error"] is None or cell["bound"] == 0:
        return None
    return cell["error"] / cell["bound"]


def _text(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "-"
    if cell["error"] is None:
        return "not finite"
    if cell["bound"] == 0:
        return f"{cell['error']:.0f} wrong"
    return f"{cell['error']:.1e} / {cell['bound']:.1e}"


def table(content: dict[str, Any]) -> str:
    """The Markdown page."""
    head, rows = content["headline"], content["rows"]
    lines = [
        "# Stability on hard cases",
        "",
        stamp_line(content["made"]),
        "",
        f"**{head['cases']} cases, {head['failed']} failed** ({head['input_cases']} inputs, {head['trainings']} "
        f"trainings). The largest error uses {100 * head['largest_share_of_a_bound']:.0f} % of its bound.",
        "",
        "Each cell is *error / bound* against exact arithmetic (float64, decimals where it cancels), relative to the",
        "magnitudes that a number is made of; where nothing may be wrong it counts what is. Bounds are roundings times",
        "condition: [docs/stability.md](../stability.md).",
        "",
        "![Error of every case as a share of its bound](stability.png)",
    ]
    names = [p.name for p in PRECISIONS]
    columns = [f"{name}, {what}" for name in names for what in ("value", "gradient")]
    for group in Counter(r["group"] for r in rows):
        lines += ["", f"## {group[0].upper()}{group[1:]}", "", f"| input | expectation | {' | '.join(columns)} | |"]
        lines += ["|---|---|" + "---|" * (len(columns) + 1)]
        for row in (r for r in rows if r["group"] == group):
            cells = [_text(row["paths"][name][what]) for name in names for what in ("value", "gradient")]
            verdict = "pass" if row["ok"] else "**FAIL**"
            lines.append(f"| {row['inputs']} | {row['expectation']} | {' | '.join(cells)} | {verdict} |")
    if content["trainings"]:
        lines += _training_table(content["trainings"])
    return "\n".join([*lines, ""])


def _training_table(trainings: dict[str, Any]) -> list[str]:
    lines = [
        "",
        "## Trainings",
        "",
        "`mmpi-small`, two phases and a fine-tune, on a still life of 9 images of 32 x 24 pixels, 64 rays a step.",
        "",
        "| setting | expectation | steps | what came of it | largest number | PSNR of a test image | |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in trainings.items():
        psnr = f"{row['psnr']:.1f}" if "psnr" in row else "-"
        largest = f"{row['largest']:.1e}" if "largest" in row else "-"
        verdict = "pass" if row["ok"] else "**FAIL**"
        cells = [name, row["expectation"], str(row["steps"]), row["outcome"], largest, psnr, verdict]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, "", f"Commits: {', '.join(sorted({r['commit'] for r in trainings.values()}))}."]


def draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """Every error as a share of its bound, by group, on a logarithmic axis."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    groups = list(dict.fromkeys(r["group"] for r in rows))
    figure, axes = plt.subplots(figsize=(8, 0.45 * len(groups) + 1.5), layout="constrained")
    marks = {("float32", "value"): ("C0", "o"), ("float32", "gradient"): ("C0", "^")}
    for p in PRECISIONS[1:]:
        marks |= {(p.name, "value"): ("C1", "o"), (p.name, "gradient"): ("C1", "^")}
    for offset, ((name, what), (color, mark)) in enumerate(marks.items()):
        points = [(use(r["paths"][name][what]), groups.index(r["group"])) for r in rows]
        shown = [(max(u, 1e-5), y + 0.15 * (offset - 1.5)) for u, y in points if u is not None]
        if shown:
            x, y = zip(*shown, strict=True)
            axes.plot(x, y, mark, color=color, ms=4, alpha=0.6, mew=0, label=f"{name}, {what}")
    axes.axvline(1, color="black", lw=1)
    axes.set(xscale="log", xlim=(6e-6, 3), xlabel="error / bound (bound at 1)", yticks=range(len(groups)))
    axes.set_yticklabels(groups)
    axes.invert_yaxis()
    axes.legend(fontsize=7, loc="upper left")
    figure.savefig(path, dpi=110)
    plt.close(figure)
