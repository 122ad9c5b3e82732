"""``mmpi-bench stability``: hard inputs against exact arithmetic, and trainings with absurd settings."""

from __future__ import annotations

import math
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

from mmpi_ns.bench.report import Bench, Report, Row, figure, fingerprint, page, table, title
from mmpi_ns.bench.stability import absurd, blending, geometry, merging, rays
from mmpi_ns.bench.stability.cases import PRECISIONS, Case, Error, Precision

CELLS = tuple((p.name, what) for p in PRECISIONS for what in ("value", "gradient"))
"""What is measured of each case."""


@dataclass
class Stability(Bench):
    """Hard cases: error of values and gradients against float64, with bounds; and absurd trainings.

    Ends with status 1 where a case fails. Started again it goes on: cases that were measured with the same sources, and
    trainings that are done, are taken from stability.json. Remove that to start afresh.
    """

    training: bool = True
    """Train with absurd settings as well."""
    steps: int = 2000
    """Steps of each of those trainings."""
    only: str = ""
    """Run only the cases (or trainings) whose group and input contain this, and write nothing."""

    name = "stability"

    def run(self) -> None:
        report, sources = Report(self, None if self.only else ""), fingerprint()
        known = report.rows if report.kept.get("sources") == sources else {}
        content = report.content | {"sources": sources, "rows": {}, "trainings": report.kept.get("trainings", {})}
        report.content, save = content, (lambda: None) if self.only else report.save
        chosen = {c.name: c for c in all_cases() if self.only in c.name}
        for number, (name, case) in enumerate(chosen.items(), 1):
            row = content["rows"][name] = known.get(name) or _row(case)
            save()
            print(f"[{number}/{len(chosen)}] {_verdict(row)} {name} ({row['seconds']:.1f} s)", flush=True)
        for absurdity in absurd.ABSURDITIES if self.training else ():
            if self.only not in f"training: {absurdity.name}":
                continue
            row = content["trainings"].get(absurdity.name, {})
            if row.get("steps") != self.steps:
                row = content["trainings"][absurdity.name] = absurd.train(absurdity, self.folder, self.steps)
                save()
            print(f"{_verdict(row)} training: {absurdity.name}: {row['outcome']}", flush=True)
        head = headline(content["rows"], content["trainings"])
        if not self.only:
            report.finish(head, markdown(content, head), lambda path: draw(path, list(content["rows"].values())))
        print(head)
        if head["failed"]:
            raise SystemExit("mmpi-bench: a case fails its bound; see the lines above that say FAIL.")


def all_cases() -> list[Case]:
    """Every case, in the order of the table."""
    return [case for group in (geometry, blending, merging, rays) for case in group.cases()]


def _verdict(row: Row) -> str:
    return "ok  " if row["ok"] else "FAIL"


def _row(case: Case) -> Row:
    """The case under every arithmetic."""
    start = time.perf_counter()
    paths = {p.name: _measure(case, p) for p in PRECISIONS}
    row = {"group": case.group, "inputs": case.inputs, "expectation": case.expectation, "paths": paths}
    return row | {"ok": all(path["ok"] for path in paths.values()), "seconds": time.perf_counter() - start}


def _measure(case: Case, precision: Precision) -> Row:
    try:
        outcome = case.measure(precision)
    except Exception as error:  # whatever a hard input makes a kernel raise is a result, not the end of the table
        traceback.print_exc(limit=-3)
        said = f"{type(error).__name__}: {error}"
        return {"value": {"error": None, "bound": 0.0}, "gradient": None, "ok": False, "raised": said}
    return {"value": _cell(outcome.value), "gradient": _cell(outcome.gradient), "ok": outcome.holds}


def _cell(error: Error | None) -> Row | None:
    """JSON knows no infinity: a result that is not finite has no error."""
    if error is None:
        return None
    return {"error": error.error if math.isfinite(error.error) else None, "bound": error.bound}


def headline(rows: dict[str, Row], trainings: dict[str, Row]) -> Row:
    """How many cases there are and how many fail; trainings among them."""
    every = [*rows.values(), *trainings.values()]
    used = [use(row["paths"][name][what]) for row in rows.values() for name, what in CELLS]
    counts = {"cases": len(every), "failed": sum(not row["ok"] for row in every), "input_cases": len(rows)}
    largest = max((u for u in used if u is not None), default=0.0)
    return counts | {"trainings": len(trainings), "largest_share_of_a_bound": largest}


def use(cell: Row | None) -> float | None:
    """Share of its bound that an error uses; None where there is no bound to share (nothing may be wrong there)."""
    if cell is None or cell["error"] is None or cell["bound"] == 0:
        return None
    return cell["error"] / cell["bound"]


def _text(cell: Row | None) -> str:
    if cell is None:
        return "-"
    if cell["error"] is None:
        return "not finite"
    return f"{cell['error']:.1e} / {cell['bound']:.1e}" if cell["bound"] else f"{cell['error']:.0f} wrong"


def markdown(content: Row, head: Row) -> str:
    """The page."""
    passed = {"": lambda r: "pass" if r["ok"] else "**FAIL**"}
    columns = {"input": "{inputs}", "expectation": "{expectation}"}
    columns |= {f"{n}, {w}": lambda r, n=n, w=w: _text(r["paths"][n][w]) for n, w in CELLS} | passed
    rows, blocks = list(content["rows"].values()), []
    for group in dict.fromkeys(r["group"] for r in rows):
        blocks += [f"## {title(group)}", table(columns, (r for r in rows if r["group"] == group))]
    if trainings := content["trainings"]:
        blocks += ["## Trainings", "`mmpi-small`, two phases and a fine-tune, on a still life of 9 images of 32 x 24 "
                   "pixels, 64 rays a step."]  # fmt: skip
        columns = {
            "setting": "{name}",
            "expectation": "{expectation}",
            "steps": "{steps}",
            "what came of it": "{outcome}",
            "largest number": lambda r: f"{r['largest']:.1e}" if "largest" in r else "-",
            "PSNR of a test image": lambda r: f"{r['psnr']:.1f}" if "psnr" in r else "-",
        }
        blocks += [table(columns | passed, ({"name": n, **r} for n, r in trainings.items()))]
        blocks += [f"Commits: {', '.join(sorted({r['commit'] for r in trainings.values()}))}."]
    counted = f"**{head['cases']} cases, {head['failed']} failed** ({head['input_cases']} inputs, {head['trainings']} "
    counted += f"trainings). The largest error uses {100 * head['largest_share_of_a_bound']:.0f} % of its bound."
    said = """\
Each cell is *error / bound* against exact arithmetic (float64, decimals where it cancels), relative to the
magnitudes that a number is made of; where nothing may be wrong it counts what is. Bounds are roundings times
condition: [docs/stability.md](../stability.md)."""
    picture = "![Error of every case as a share of its bound](stability.png)"
    return page("Stability on hard cases", content["made"], counted, said, picture, blocks)


def draw(path: Path, rows: list[Row]) -> None:
    """Every error as a share of its bound, by group, on a logarithmic axis."""
    groups = list(dict.fromkeys(r["group"] for r in rows))
    with figure(path, 1, 1, (8, 0.45 * len(groups) + 1.5)) as ((axis,),):
        for offset, (name, what) in enumerate(CELLS):
            points = [(use(r["paths"][name][what]), groups.index(r["group"])) for r in rows]
            shown = [(max(u, 1e-5), y + 0.15 * (offset - 1.5)) for u, y in points if u is not None]
            style = {"color": f"C{offset // 2}", "ms": 4, "alpha": 0.6, "mew": 0, "label": f"{name}, {what}"}
            axis.plot([x for x, _ in shown], [y for _, y in shown], "o^"[offset % 2], **style)
        axis.axvline(1, color="black", lw=1)
        axis.set(xscale="log", xlim=(6e-6, 3), xlabel="error / bound (bound at 1)")
        axis.set_yticks(range(len(groups)), groups)
        axis.invert_yaxis()
