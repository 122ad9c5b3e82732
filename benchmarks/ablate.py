"""What each part of the method is worth, at equal rays and at equal time."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from lab import SceneBench, figure, not_run
from methods import Method
from report import Cell, Report, Row, commit, page, slug, table, title
from suites import ABLATIONS
from trainings import Request, train_apart

from mmpi_ns.scripts.command import run

NEAR = 0.1
"""A run whose steps differ by less than this from those at equal time counts as both."""


@dataclass
class Ablate(SceneBench):
    """Every variant of an ablation, first with the reference's steps, then for the seconds that the reference took.

    How many steps fit is computed from the variant's own first run. Finished runs are kept in ablate-SUITE.json.
    """

    suite: Literal["drive", "room", "depth"] = "drive"
    """drive: the paper's KITTI ablation and ours; room: its ScanNet one, with and without the cube."""
    steps: int = 1500
    """Steps at equal rays."""
    rays: int = 1024
    """Pixel rays of a step."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of every variant."""
    equal_time: bool = True
    """Run at equal time as well."""
    test_images: int = 0
    """Test images, evenly spaced, for PSNR and SSIM; 0 for all."""
    only: str = ""
    """Run only the reference and variants whose name contains this."""

    name = "ablate"

    def run(self) -> None:
        key = f"{self.scene.name} /{self.downscale_factor}, {self.steps} steps of {self.rays} rays"
        key += f", {self.cores} threads, {self.test_images or 'all'} test images"
        report = Report(self, key, f"ablate-{self.suite}")
        first, *others = ABLATIONS[self.suite]
        for variant in (first, *(v for v in others if self.only in v.name)):
            for seed in self.seeds:
                row = self._ensure(report, variant, seed, self.steps)
                if self.equal_time and "not_run" not in row:
                    self._ensure_equal_time(report, variant, seed, row)
        print(report.content["headline"])

    def _ensure_equal_time(self, report: Report, variant: Method, seed: int, row: Row) -> None:
        reference = report.rows[_key(ABLATIONS[self.suite][0].name, seed, self.steps)]
        if "not_run" in reference:
            raise ValueError(f"The reference failed: {reference['not_run']}")
        steps = equal_time_steps(reference, row)
        if steps != self.steps:
            # The speed of the machine comes and goes: a run that was made for this stays the one.
            own = [r for r in report.rows.values() if (r["name"], r["seed"]) == (variant.name, seed)]
            known = [r["steps"] for r in own if "not_run" not in r and r["steps"] != self.steps]
            self._ensure(report, variant, seed, known[0] if known else steps)

    def _ensure(self, report: Report, variant: Method, seed: int, steps: int) -> Row:
        """Makes a row unless it is there, and writes everything."""
        key = _key(variant.name, seed, steps)
        row = report.row(key, lambda: self._train(variant, seed, steps), needed=False)
        print(f"{key}: {row.get('not_run') or '{psnr:.2f} dB, {seconds:.0f} s'.format(**row)}", flush=True)
        found = results(self.suite, report.rows, self.steps)
        report.finish(headline(found), markdown(self.suite, report.content, found), lambda path: draw(path, found))
        return row

    def _train(self, variant: Method, seed: int, steps: int) -> Row:
        key = _key(variant.name, seed, steps)
        print(f"{key} ...", flush=True)
        folder = self.folder / self.suite / slug(key)
        looks: Row = {"check_images": self.test_images, "final_images": self.test_images}
        request = Request.of(variant, self.scene, folder, steps, self.rays, seed, **looks)
        row = {"name": variant.name, "seed": seed, "steps": steps, "commit": commit(), "options": request.shown}
        return {**row, "what": f"{variant.name}, seed {seed}", **train_apart(request, self.cores)}


def _key(name: str, seed: int, steps: int) -> str:
    return f"{name}; seed {seed}; {steps} steps"


def equal_time_steps(reference: Row, row: Row) -> int:
    """Steps of a variant in the seconds of the reference (setting up included); its own where they are near."""
    left = reference["seconds"] - row["setup_seconds"]
    steps = round(row["steps"] * left / (row["seconds"] - row["setup_seconds"]))
    return row["steps"] if abs(steps / row["steps"] - 1) < NEAR else max(1, steps)


def results(suite: str, rows: dict[str, Row], steps: int) -> dict[str, Row]:
    """Per variant that ran: means over seeds at equal rays, and at equal time where that ran; gains over the first."""
    found: dict[str, Row] = {}
    reference = {r["seed"]: r for r in rows.values() if r["name"] == ABLATIONS[suite][0].name and "psnr" in r}
    for variant in ABLATIONS[suite]:
        own = [r for r in rows.values() if r["name"] == variant.name and "not_run" not in r]
        equal, other = [r for r in own if r["steps"] == steps], [r for r in own if r["steps"] != steps]
        near = [r for r in equal if r["seed"] in reference and equal_time_steps(reference[r["seed"]], r) == steps]
        if equal:
            found[variant.name] = {"name": variant.name, "group": variant.group, "rays": _means(equal)}
            found[variant.name]["time"] = _means(other or near)
    for means in (entry[what] for entry in found.values() for what in ("rays", "time")):
        if means:
            means["gain"] = means["psnr"] - next(iter(found.values()))["rays"]["psnr"]
    return found


def _means(rows: list[Row]) -> Row | None:
    if not rows:
        return None
    means = {k: float(np.mean([r[k] for r in rows])) for k in ("psnr", "ssim", "seconds", "rays", "steps")}
    return {**means, "spread": float(np.std([r["psnr"] for r in rows], ddof=1)) if len(rows) > 1 else None}


def headline(found: dict[str, Row]) -> dict[str, float]:
    """Gains in PSNR over the reference, at equal rays and at equal time."""
    made: dict[str, float] = {}
    for number, (name, entry) in enumerate(found.items()):
        if number == 0:
            made |= {"reference_psnr_db": entry["rays"]["psnr"], "reference_seconds": entry["rays"]["seconds"]}
            continue
        made[f"{slug(name)}_delta_db"] = entry["rays"]["gain"]
        if entry["time"] is not None:
            made[f"{slug(name)}_delta_at_equal_time_db"] = entry["time"]["gain"]
    return made


def markdown(suite: str, content: Row, found: dict[str, Row]) -> str:
    """The page."""

    def psnr(means: Row | None) -> str:
        spread = f" ± {means['spread']:.2f}" if means and means["spread"] is not None else ""
        return "" if means is None else f"{means['psnr']:.2f}{spread}"

    def at_equal_time(form: str) -> Cell:
        return lambda row: "" if row["time"] is None else form.format(**row["time"])

    columns = {
        "variant": "{name}",
        "PSNR, equal rays": lambda row: psnr(row["rays"]),
        "gain": "{rays[gain]:+.2f}",
        "SSIM": "{rays[ssim]:.3f}",
        "seconds": "{rays[seconds]:.0f}",
        "steps at equal time": at_equal_time("{steps:.0f}"),
        "PSNR, equal time": lambda row: psnr(row["time"]),
        "gain ": at_equal_time("{gain:+.2f}"),
        "seconds ": at_equal_time("{seconds:.0f}"),
    }
    blocks = []
    for group in dict.fromkeys(entry["group"] for entry in found.values()):
        blocks += [f"## {title(group)}", table(columns, (e for e in found.values() if e["group"] == group))]
    commits = ", ".join(sorted({r["commit"] for r in content["rows"].values()}))
    said = f"""\
{content["key"]}. PSNR and SSIM are means over whole test images (and seeds; ± their standard deviation).
At equal time a variant gets as many steps as fit into the seconds of the reference, the first row; its
schedule follows their number. Runs within {100 * NEAR:.0f} % of equal time are not repeated."""
    last = f"Commits: {commits}. Options of each row: `ablate-{suite}.json`."
    figure_line = f"![Gains over the reference](ablate-{suite}.png)"
    return page(f"Ablation: {suite}", content["made"], said, figure_line, blocks, not_run(content["rows"]), last)


def draw(path: Path, found: dict[str, Row]) -> None:
    """Gains over the reference as bars."""
    if not found:
        return
    names = list(found)
    with figure(path, 1, 1, (8, 0.45 * len(names) + 1.5)) as ((axis,),):
        for offset, what in enumerate(("rays", "time")):
            gains = [(found[n][what] or {"gain": 0.0})["gain"] for n in names]
            places = np.arange(len(names)) + 0.4 * offset - 0.2
            axis.barh(places, gains, height=0.38, color=f"C{offset}", label=f"equal {what}")
        axis.set_yticks(range(len(names)), names, fontsize=8)
        axis.invert_yaxis()
        axis.axvline(0, color="black", lw=1)
        axis.set(xlabel=f"PSNR of test views over {names[0]}, dB")


if __name__ == "__main__":
    sys.exit(run("ablate", Ablate))
