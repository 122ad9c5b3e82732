"""``mmpi-bench ablate``: what each part of the method is worth, at equal rays and at equal time."""

from __future__ import annotations

import math
import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mmpi_ns.bench.methods import Method, Scene
from mmpi_ns.bench.provenance import commit, read_json, stamp, stamp_line, write_json
from mmpi_ns.bench.quality.train import shown, train_apart
from mmpi_ns.bench.suites import ABLATIONS, Variant
from mmpi_ns.bench.trainings import Request

NEAR = 0.1
"""A run whose steps differ by less than this from those at equal time counts as both."""


@dataclass
class Ablate:
    """Every variant of an ablation, first with the reference's steps, then for the seconds that the reference took.

    How many steps fit is computed from the variant's own first run. Finished runs are kept in ablate-SUITE.json.
    """

    data: Path
    """The scene (a folder with transforms.json)."""
    suite: Literal["drive", "room"] = "drive"
    """drive: the paper's KITTI ablation and ours; room: its ScanNet one, with and without the cube."""
    downscale_factor: int = 4
    """Image size to use."""
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
    threads: int = 0
    """0 for all cores."""
    only: str = ""
    """Run only the reference and variants whose name contains this."""
    output: Path = Path("docs/results")
    """Where ablate-SUITE.json, .md and .png go."""
    work: Path = Path("outputs/ablate")
    """Where runs and their logs go."""

    def run(self) -> None:
        made, path = stamp("ablate", self), self.output / f"ablate-{self.suite}.json"
        made["threads"] = self.threads or os.cpu_count() or 1
        key = f"{self.data.resolve().name} /{self.downscale_factor}, {self.steps} steps of {self.rays} rays"
        key += f", {made['threads']} threads, {self.test_images or 'all'} test images"
        before = read_json(path)
        content: dict[str, Any] = {"headline": {}, "made": made, "key": key}
        content["rows"] = before.get("rows", {}) if before.get("key") == key else {}
        variants = [v for i, v in enumerate(ABLATIONS[self.suite]) if i == 0 or self.only in v.name]
        for variant in variants:
            for seed in self.seeds:
                self._ensure(content, path, variant, seed, self.steps)
                self._ensure_equal_time(content, path, variant, seed)
        print(content["headline"])

    def _ensure_equal_time(self, content: dict[str, Any], path: Path, variant: Variant, seed: int) -> None:
        rows, reference = content["rows"], ABLATIONS[self.suite][0].name
        if not self.equal_time or "not_run" in rows[_key(variant.name, seed, self.steps)]:
            return
        given = rows[_key(reference, seed, self.steps)]
        if "not_run" in given:
            raise ValueError(f"The reference failed: {given['not_run']}")
        steps = equal_time_steps(given, rows[_key(variant.name, seed, self.steps)])
        if steps != self.steps:
            # The speed of the machine comes and goes: a run that was made for this stays the one.
            known = [r["steps"] for r in rows.values() if _is(r, variant.name, seed) and r["steps"] != self.steps]
            self._ensure(content, path, variant, seed, known[0] if known else steps)

    def _ensure(self, content: dict[str, Any], path: Path, variant: Variant, seed: int, steps: int) -> None:
        """Makes a row unless it is there, and writes everything."""
        rows, key = content["rows"], _key(variant.name, seed, steps)
        if "not_run" in rows.get(key, {"not_run": ""}):
            print(f"{key} ...", flush=True)
            rows[key] = {"name": variant.name, "seed": seed, "steps": steps, "commit": commit()}
            rows[key] |= self._train(variant, seed, steps, content["made"]["threads"])
        row = rows[key]
        said = row.get("not_run") or f"{row['psnr']:.2f} dB, {row['seconds']:.0f} s"
        print(f"{key}: {said}", flush=True)
        content["headline"] = headline(self.suite, rows, self.steps)
        write_json(path, content)
        (self.output / f"ablate-{self.suite}.md").write_text(table(self.suite, content, self.steps), encoding="utf-8")
        draw(self.output / f"ablate-{self.suite}.png", self.suite, rows, self.steps)

    def _train(self, variant: Variant, seed: int, steps: int, threads: int) -> dict[str, Any]:
        folder = self.work / self.suite / _slug(_key(variant.name, seed, steps))
        method = Method(variant.name, variant.method, variant.options)
        words = method.words(Scene(self.data, self.downscale_factor), folder, steps, self.rays, seed, "cpu")
        request = Request(
            words=tuple(words),
            data=str(self.data),
            downscale_factor=self.downscale_factor,
            work=str(folder),
            checks=(steps,),
            check_images=self.test_images,
            check_pixels=64,
            final_images=self.test_images,
            whole_images=False,
            keep=False,
        )
        return {"options": shlex.join(shown(request.words)), **train_apart(request, folder, threads)}


def _key(name: str, seed: int, steps: int) -> str:
    return f"{name}; seed {seed}; {steps} steps"


def _is(row: dict[str, Any], name: str, seed: int) -> bool:
    return row["name"] == name and row["seed"] == seed and "not_run" not in row


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def equal_time_steps(reference: dict[str, Any], row: dict[str, Any]) -> int:
    """Steps of a variant in the seconds of the reference (setting up included); its own where they are near."""
    left = reference["seconds"] - row["setup_seconds"]
    steps = round(row["steps"] * left / (row["seconds"] - row["setup_seconds"]))
    return row["steps"] if abs(steps / row["steps"] - 1) < NEAR else max(1, steps)


def results(suite: str, rows: dict[str, Any], steps: int) -> dict[str, dict[str, Any]]:
    """Per variant that ran: means over seeds at equal rays, and at equal time where that ran."""
    found: dict[str, dict[str, Any]] = {}
    for variant in ABLATIONS[suite]:
        own = [r for r in rows.values() if r["name"] == variant.name and "not_run" not in r]
        equal = [r for r in own if r["steps"] == steps]
        if not equal:
            continue
        entry = found[variant.name] = {"group": variant.group, "rays": _means(equal)}
        other = [r for r in own if r["steps"] != steps]
        reference = {r["seed"]: r for r in rows.values() if r["name"] == ABLATIONS[suite][0].name and "psnr" in r}
        near = [r for r in equal if r["seed"] in reference and equal_time_steps(reference[r["seed"]], r) == steps]
        entry["time"] = _means(other or near) if other or near else None
    return found


def _means(rows: list[dict[str, Any]]) -> dict[str, Any]:
    means = {k: float(np.mean([r[k] for r in rows])) for k in ("psnr", "ssim", "seconds", "rays", "steps")}
    return {**means, "spread": float(np.std([r["psnr"] for r in rows], ddof=1)) if len(rows) > 1 else None}


def headline(suite: str, rows: dict[str, Any], steps: int) -> dict[str, float]:
    """Gains in PSNR over the reference, at equal rays and at equal time."""
    found, given = {}, results(suite, rows, steps)
    reference = given.get(ABLATIONS[suite][0].name)
    if reference is None:
        return {}
    found["reference_psnr_db"] = reference["rays"]["psnr"]
    found["reference_seconds"] = reference["rays"]["seconds"]
    for name, entry in list(given.items())[1:]:
        found[f"{_slug(name)}_delta_db"] = entry["rays"]["psnr"] - reference["rays"]["psnr"]
        if entry["time"] is not None:
            found[f"{_slug(name)}_delta_at_equal_time_db"] = entry["time"]["psnr"] - reference["rays"]["psnr"]
    return {k: v for k, v in found.items() if math.isfinite(v)}


def table(suite: str, content: dict[str, Any], steps: int) -> str:
    """The Markdown page."""
    rows = content["rows"]
    given = results(suite, rows, steps)
    lines = [
        f"# Ablation: {suite}",
        "",
        stamp_line(content["made"]),
        "",
        f"{content['key']}. PSNR and SSIM are means over whole test images (and seeds; ± their standard deviation).",
        "At equal time a variant gets as many steps as fit into the seconds of the reference, the first row; its",
        f"schedule follows their number. Runs within {100 * NEAR:.0f} % of equal time are not repeated.",
        "",
        f"![Gains over the reference](ablate-{suite}.png)",
    ]
    reference = next(iter(given.values()), None)
    for group in dict.fromkeys(v.group for v in ABLATIONS[suite]):
        members = {n: e for n, e in given.items() if e["group"] == group}
        if members and reference is not None:
            lines += ["", f"## {group[0].upper()}{group[1:]}", "", _HEADER, "|---|" + "---|" * 8]
            lines += [_line(n, e, reference["rays"]["psnr"]) for n, e in members.items()]
    failed = [f"- {r['name']}, seed {r['seed']}: {r['not_run']}." for r in rows.values() if "not_run" in r]
    if failed:
        lines += ["", "Not run:", "", *failed]
    commits = ", ".join(sorted({r["commit"] for r in rows.values()}))
    return "\n".join([*lines, "", f"Commits: {commits}. Options of each row: `ablate-{suite}.json`.", ""])


_HEADER = (
    "| variant | PSNR, equal rays | gain | SSIM | seconds | steps at equal time | PSNR, equal time | gain | seconds |"
)


def _line(name: str, entry: dict[str, Any], reference: float) -> str:
    def psnr(means: dict[str, Any]) -> list[str]:
        spread = "" if means["spread"] is None else f" ± {means['spread']:.2f}"
        return [f"{means['psnr']:.2f}{spread}", f"{means['psnr'] - reference:+.2f}"]

    rays, time = entry["rays"], entry["time"]
    cells = [name, *psnr(rays), f"{rays['ssim']:.3f}", f"{rays['seconds']:.0f}"]
    cells += [""] * 4 if time is None else [f"{time['steps']:.0f}", *psnr(time), f"{time['seconds']:.0f}"]
    return "| " + " | ".join(cells) + " |"


def draw(path: Path, suite: str, rows: dict[str, Any], steps: int) -> None:
    """Gains over the reference as bars."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    given = results(suite, rows, steps)
    if not given:
        return
    reference, names = next(iter(given.values()))["rays"]["psnr"], list(given)
    figure, axis = plt.subplots(figsize=(8, 0.45 * len(names) + 1.5), layout="constrained")
    for offset, (what, label) in enumerate((("rays", "equal rays"), ("time", "equal time"))):
        gains = [given[n][what]["psnr"] - reference if given[n][what] else 0.0 for n in names]
        axis.barh(np.arange(len(names)) + 0.4 * offset - 0.2, gains, height=0.38, color=f"C{offset}", label=label)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.invert_yaxis()
    axis.axvline(0, color="black", lw=1)
    axis.set(xlabel=f"PSNR of test views over {names[0]}, dB")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3, axis="x")
    figure.savefig(path, dpi=110)
    plt.close(figure)
