"""Makes every number of README.md and docs/results/README.md with the real commands, as a user types them.

    make results DATA=captures/          # captures by their names below

Finished rows are kept, and an interrupted training goes on from its last checkpoint.
Captures that the folder lacks are left out, and the pages name them.
"""

from __future__ import annotations

import json
import re
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path

from lab import figure, train_and_evaluate
from report import Bench, Report, Row, read_json, slug, stamp_line, table
from trainers import Scene

from mmpi_ns.scripts.command import run

ROOT = Path(__file__).resolve().parents[1]
LPIPS = ("--pipeline.model.lpips-net", "none")
"""Its weights cannot be had everywhere."""
RAYS = ("--pipeline.datamanager.train-num-rays-per-batch", "1024")
"""The paper does not name its rays a step."""
JOINT = ("--pipeline.model.schedule.training", "joint")
FRONT = ("--pipeline.model.placement.faces", "front")
PIECE = 64
"""Frames of a piece of long-road, as many as kitti-street has; every third one, from the first, trains."""


@dataclass(frozen=True)
class Variant:
    """One training of a capture."""

    capture: str
    factor: int
    method: str = "mmpi"
    options: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0,)
    name: str = "defaults"
    table: str = "defaults"
    """Name in ``TABLES``."""
    first: int | None = None
    """First frame of the piece that is used; None for the whole capture."""

    @property
    def scene(self) -> str:
        """The capture as tables name it."""
        return self.capture + ("" if self.first is None else f" from {self.first}") + f" /{self.factor}"

    @property
    def key(self) -> str:
        return f"{self.scene}, {self.method}, {self.name}"


TABLES = {
    "defaults": "Defaults",
    "lengths": "Longer and shorter",
    "paper": "The paper's methods",
}
"""Titles of the tables by the names of their files; each is made on one commit."""
STREET = ("kitti-street", 4)


def steps(count: int) -> tuple[str, str]:
    """The option. The paper's methods take as many epochs as at full size: its steps divided by the pixels' factor."""
    return ("--max-num-iterations", str(count))


SCENES = (STREET, ("kitti-street", 1), ("kitchen", 2), ("fox", 2), ("room-walk", 2), ("phone-walk", 2))
LONGER = SCENES[1:4]
"""Captures whose steps size 4 changes."""
VARIANTS = (
    *(Variant(*scene, seeds=(0, 1, 2)) for scene in SCENES),
    *(
        Variant(*scene, options=steps(n), name=f"{n:,} steps", table="lengths")
        for scene, lengths in (
            (STREET, (300, 600, 1250, 10_000)),
            (("kitti-street", 1), (1000,)),
            (("kitchen", 2), (1000,)),
            (("fox", 2), (1000,)),
            (("room-walk", 2), (600, 10_000)),
            (("phone-walk", 2), (1000,)),
        )
        for n in lengths
    ),
    *(Variant(*scene, options=("--pipeline.model.size", "4"), name="size 4", table="lengths") for scene in LONGER),
    *(
        Variant(capture, factor, "mmpi-kitti", (*steps(2500), *RAYS, *options), seeds, name, "paper", first)
        for capture, factor, first, seeds in (
            (*STREET, None, (0, 1, 2)),
            ("long-road", 2, 1, (0,)),
            ("long-road", 2, 142, (0,)),
        )
        for name, options in (
            ("one MPI (front), joint", (*FRONT, *JOINT)),
            ("four MPIs, joint", JOINT),
            ("four MPIs, each alone, then reliability", ()),
        )
    ),
    Variant("kitti-street", 1, "mmpi-kitti", RAYS, name="all 40,000 steps, of 1,024 rays", table="paper"),
    *(
        Variant(capture, 2, method, (*steps(n), *RAYS), name=f"{n:,} steps of 1,024 rays", table="paper")
        for capture in ("kitchen", "room-walk")
        for method, n in (("mmpi-scannet", 7500), ("mmpi-scannet-short", 2500))
    ),
)


@dataclass
class Results(Bench):
    """Trains and evaluates all variants; finished ones are kept. Fills the tables of README.md and of
    docs/results/README.md."""

    data: Path = Path("captures")
    """Folder with the captures."""
    only: str = ""
    """Run only variants whose key or table contains this."""

    name = "results"

    def run(self) -> None:
        for name in TABLES:
            asked = [v for v in VARIANTS if v.table == name and self.only in f"{name}: {v.key}"]
            if not asked:
                continue
            report = Report(self, self.key("only", "data"), name)
            for variant in asked:
                for seed in variant.seeds:
                    report.row(f"{variant.key}, seed {seed}", lambda v=variant, s=seed: self._row(v, s), needed=False)
            report.content["headline"] = {f"{slug(key)}_psnr": r["psnr"] for key, r in finished(report.content).items()}
            report.save()
        made, scored = read_tables(self.output), read_json(self.output / "score.json")
        draw(self.output / "results.png", made, scored)
        fill(self.output / "README.md", {"results": results_page(made)})
        fill(ROOT / "README.md", {"results": readme_table(made, scored)})

    def _row(self, variant: Variant, seed: int) -> Row:
        if not (self.data / variant.capture / "transforms.json").is_file():
            return {"not_run": "the capture is not there"}
        folder = self.folder / slug(f"{variant.key} {seed}", "-")
        options = [*LPIPS, "--machine.seed", str(seed), *variant.options]
        renders = ["--render-output-path", str(folder / "renders")]
        data = self.data / variant.capture
        scene = Scene(data if variant.first is None else piece(data, variant.first, folder / "piece"), variant.factor)
        _, results, made = train_and_evaluate(scene, folder, variant.method, options, renders, self.cores, True)
        row = {k: results[k] for k in ("psnr", "ssim", "field_psnr", "field_ssim") if k in results}
        row |= {"key": variant.key, "capture": variant.scene}
        row |= {"name": f"`{variant.method}`" + (f", {variant.name}" if variant.name != "defaults" else "")}
        print(f"{variant.key}, seed {seed}: {row['psnr']:.2f} dB, {row['ssim']:.3f}", flush=True)
        return row | made | {"command": " ".join(["ns-train", variant.method, *options])}


def piece(data: Path, first: int, folder: Path) -> Path:
    """A folder with ``PIECE`` frames of a capture whose images lie in ``images``; its images are links."""
    folder.mkdir(parents=True, exist_ok=True)
    for images in data.glob("images*"):
        (folder / images.name).unlink(missing_ok=True)
        (folder / images.name).symlink_to(images.resolve())
    content = json.loads((data / "transforms.json").read_text(encoding="utf-8"))
    frames = sorted(content["frames"], key=lambda frame: frame["file_path"])[first : first + PIECE]
    names = [frame["file_path"] for frame in frames]
    tests = [name for i, name in enumerate(names) if i % 3]
    lists = {"train_filenames": names[::3], "val_filenames": tests, "test_filenames": tests}
    (folder / "transforms.json").write_text(json.dumps(content | {"frames": frames} | lists), encoding="utf-8")
    return folder


# Tables --------------------------------------------------------------------------------------------------------------


def read_tables(folder: Path) -> dict[str, Row]:
    """The files of all tables that were made, by name."""
    return {name: content for name in TABLES if (content := read_json(folder / f"{name}.json"))}


def finished(content: Row) -> dict[str, Row]:
    return {key: row for key, row in content["rows"].items() if "not_run" not in row}


def means(content: Row) -> list[Row]:
    """Rows of a table, several seeds as their means with standard deviations."""
    rows: dict[str, list[Row]] = {}
    for row in finished(content).values():
        rows.setdefault(row["key"], []).append(row)
    merged = []
    for same in rows.values():
        row = dict(same[0])
        for name in ("psnr", "ssim", "field_psnr", "field_ssim", "train_seconds", "processor_seconds", "gib"):
            values = [r[name] for r in same if name in r]
            row[name] = statistics.fmean(values) if values else None
        row["spread"] = f" ± {statistics.stdev(r['psnr'] for r in same):.2f}" if len(same) > 1 else ""
        merged.append(row)
    return merged


def peers(scored: Row, capture: str) -> list[Row]:
    """Rows of other programs whose training took a known time."""
    return [r for r in scored.get("rows", {}).values() if r["scene"] == capture and r["seconds"]]


def readme_table(made: dict[str, Row], scored: Row) -> str:
    """The captures of README.md, with the best of other programs on the same test images."""
    lines = []
    for row in means(made["defaults"]):
        others = peers(scored, row["capture"]) + peers(scored, row["capture"].replace(" ", "-undistorted "))
        best = max(others, key=lambda r: r["psnr"], default=None)
        other = f"{best['psnr']:.2f} / {best['ssim']:.3f} ({best['seconds']:.0f} s)" if best else ""
        lines.append(row | {"other": other})
    columns = {
        "capture": "{capture}",
        "PSNR / SSIM": "{psnr:.2f} / {ssim:.3f}",
        "field alone": "{field_psnr:.2f} / {field_ssim:.3f}",
        "processor time, memory": lambda r: (
            f"{r['processor_seconds'] / 60:.0f} min, {r['gib']:.1f} GiB" if r["processor_seconds"] else ""
        ),
        "3D Gaussian splatting on a CPU": "{other}",
    }
    return table(columns, lines)


def results_page(made: dict[str, Row]) -> str:
    """All tables of docs/results/README.md."""
    columns = {
        "capture": "{capture}",
        "method": "{name}",
        "PSNR": "{psnr:.2f}{spread}",
        "SSIM": "{ssim:.3f}",
        "field alone": lambda r: f"{r['field_psnr']:.2f} / {r['field_ssim']:.3f}" if r["field_psnr"] else "the same",
        "processor s": lambda r: f"{r['processor_seconds']:.0f}" if r["processor_seconds"] else "",
        "GiB": lambda r: f"{r['gib']:.1f}" if r["gib"] else "",
    }
    blocks = []
    for name, content in made.items():
        done, stamp = finished(content), stamp_line(content["made"])
        blocks += [f"**{TABLES[name]}**", *([stamp] if stamp not in blocks else []), table(columns, means(content))]
        missing = []
        for variant in (v for v in VARIANTS if v.table == name):
            seeds = [seed for seed in variant.seeds if f"{variant.key}, seed {seed}" not in done]
            some = f" (seeds {', '.join(map(str, seeds))})" if 0 < len(seeds) < len(variant.seeds) else ""
            missing += [variant.key + some] if seeds else []
        if missing:
            blocks += [f"Not run: {'; '.join(missing)}."]
    blocks += ["![PSNR and SSIM over seconds](results.png)"]
    return "\n\n".join(blocks)


def fill(page: Path, parts: dict[str, str]) -> None:
    """Replaces what stands between ``<!-- name -->`` and ``<!-- /name -->``.

    Raises:
        ValueError: the page has no such place.
    """
    text = page.read_text(encoding="utf-8")
    for name, part in parts.items():
        place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
        if not place.search(text):
            raise ValueError(f"{page} has no place for {name}.")
        text = place.sub(lambda match, part=part: f"{match[1]}\n{part}\n\n{match[2]}", text)
    page.write_text(text, encoding="utf-8")


def draw(path: Path, made: dict[str, Row], scored: Row) -> None:
    """PSNR and SSIM over seconds of training on one capture: ours by length, and other programs."""
    capture = f"{STREET[0]} /{STREET[1]}"
    ours = {name: [r for r in means(content) if r["capture"] == capture] for name, content in made.items()}
    paper = ours.pop("paper", [])
    if len({content["made"]["processor"] for name, content in made.items() if name in ours}) > 1:
        del ours["defaults"]  # seconds of two processors are no line
    timed = (r for rows in ours.values() for r in rows if r["processor_seconds"])
    lengths = sorted(timed, key=lambda r: r["processor_seconds"])
    if not lengths:
        return
    kinds: tuple[tuple[str, list[Row], str, str], ...] = (
        ("mmpi, more and more steps", lengths, "o-", "processor_seconds"),
        ("mmpi-kitti (paper)", paper, "s", "processor_seconds"),
        ("OpenSplat, two processors", peers(scored, capture), "^", "seconds"),
    )
    ticks = (30, 60, 120, 300, 600, 1200, 3600)
    with figure(path, 1, 2, (9, 3.4)) as (axes,):
        for axis, what, label in zip(axes, ("psnr", "ssim"), ("PSNR, dB", "SSIM"), strict=True):
            for name, rows, style, seconds in (kind for kind in kinds if kind[1]):
                axis.plot([r[seconds] for r in rows], [r[what] for r in rows], style, label=name)
            field = f"field_{what}"
            axis.plot(
                [r["processor_seconds"] for r in lengths], [r[field] for r in lengths], "o--", label="field alone"
            )
            axis.set(xscale="log", xlabel="processor seconds of training", ylabel=label, title=capture)
            axis.set_xticks(ticks, [f"{t:,}" for t in ticks])
            axis.minorticks_off()


if __name__ == "__main__":
    sys.exit(run("results", Results))
