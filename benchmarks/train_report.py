"""What ``python benchmarks/train.py`` found: headline, table and figure, from its rows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from curves import Curve, compare
from lab import figure, not_run
from methods import METHODS
from report import Row, page, slug, table

TIMES = (10, 30, 60, 120, 300, 600, 1200, 1800, 3600)
"""Seconds at which the second table compares."""
QUICK = " (quick hashes)"
"""What follows the name of a peer whose hash tables are looked up by ``peers.look_up_quickly``."""
PEERS = ("nerfacto", "nerfacto" + QUICK, "depth-nerfacto" + QUICK, "instant-ngp", "splatfacto")


@dataclass(frozen=True)
class Group:
    """Rows that differ in their seed alone."""

    scene: str
    """Name and size."""
    setting: str
    """Machine and what was looked at: rows of one scene and setting share a table."""
    method: str
    steps: int
    rows: list[Row]

    @property
    def curve(self) -> Curve:
        return Curve.of(self.rows)

    def mean(self, name: str) -> float:
        return float(np.mean([r[name] for r in self.rows]))

    def spread(self) -> float | None:
        """Standard deviation of PSNR over seeds; None for one seed."""
        return float(np.std([r["psnr"] for r in self.rows], ddof=1)) if len(self.rows) > 1 else None


def tables(rows: dict[str, Row]) -> dict[tuple[str, str], list[Group]]:
    """All that ran, by scene and setting, in the order in which methods were first named."""
    results: dict[tuple[str, str, str, int], Group] = {}
    for key, row in rows.items():
        # 0 images stand for all of them.
        setting = key.partition("; ")[2].replace("of 0 images", "of every test image")
        setting = setting.replace(", 0 whole", ", all whole at the end")
        where = (f"{row['scene']} /{row['downscale_factor']}", setting, row["method"], row["steps"])
        if "not_run" not in row:
            results.setdefault(where, Group(*where, [])).rows.append(row)
    result: dict[tuple[str, str], list[Group]] = {}
    for g in sorted(results.values(), key=lambda g: (g.scene, g.setting)):
        result.setdefault((g.scene, g.setting), []).append(g)
    return result


def headline(rows: dict[str, Row]) -> dict[str, float]:
    """Figures by name; a scene's name leads where there are several scenes, settings or devices."""
    results: dict[str, float] = {}
    by_table = tables(rows)
    for (scene, setting), groups in by_table.items():
        prefix = slug(scene) + "_" if len({s for s, _ in by_table}) > 1 else ""
        prefix += slug(setting) + "_" if sum(s == scene for s, _ in by_table) > 1 else ""
        results |= {prefix + k: v for k, v in _of_table(groups).items()}
    return results


def _of_table(groups: list[Group]) -> dict[str, float]:
    """Figures of one scene. The longest run of a method has its name, shorter ones their steps as well."""
    results: dict[str, Any] = {}
    for g in groups:
        longest = max(o.steps for o in groups if o.method == g.method) == g.steps
        name = slug(g.method) + ("" if longest else f"_{g.steps}")
        results |= {f"{name}_psnr_db": g.mean("psnr"), f"{name}_psnr_spread_db": g.spread()}
        results |= {f"{name}_ssim": g.mean("ssim"), f"{name}_seconds": g.mean("seconds")}
    results = {k: v for k, v in results.items() if v is not None}
    names = [g.method for g in groups if g.rows[0]["ours"]]
    own = "mmpi-small" if "mmpi-small" in names else next(iter(names), "")
    ours = [g for g in groups if g.method == own]
    for peer in PEERS:
        theirs = [g for g in groups if g.method == peer]
        if not theirs or not ours:
            continue
        longest, name = max(theirs, key=lambda g: g.steps), slug(peer)
        compared = compare([g.curve for g in ours], longest.curve, name)
        compared["delta_at_end_db"] = max(g.mean("psnr") for g in ours) - longest.mean("psnr")
        # The peer that runs everywhere has the plain names.
        plain = peer == "nerfacto"
        results |= {k if plain or name in k else f"{name}_{k}": v for k, v in compared.items()}
    return results


def markdown(content: Row) -> str:
    """The page."""
    rows, blocks = content["rows"], []
    for (scene, setting), groups in tables(rows).items():
        split = groups[0].rows[0]["split"]
        intro = f"{split['train']} training and {split['test']} test images, {setting}."
        blocks += [f"## {scene}", intro, table(_COLUMNS, ({"g": g} for g in groups))]
        blocks += ["PSNR (on the way) after so many seconds:", _times(groups)]
    commits = sorted({f"{r['commit']} ({r['date']})" for r in rows.values() if "commit" in r})
    commands = dict.fromkeys(r["command"] for r in rows.values() if "command" in r)
    blocks += [not_run(rows), "Rows were made by:", "\n".join(f"    {c}" for c in commands)]
    blocks += [f"Commits: {', '.join(commits)}.", "Options of each row: `train.json`."]
    return page("Error against time and rays", content["made"], _PROTOCOL, "![PSNR](train.png)", blocks)


_PROTOCOL = """\
All methods train with the same images, sizes and poses and are scored on the scene's test images; cameras are
not optimised. Seconds count from the setting up of the trainer (images read, MPIs placed, kernels compiled) and
not while test images are rendered. PSNR and SSIM are means over whole test images at the end, ± the standard
deviation over seeds; on the way, PSNR is the mean over a fixed draw of pixels of each test image. Processor seconds
are those of the training process: with one thread, what the clock would have shown on an idle machine. nerfstudio's
methods run through its own trainer with their own settings but for the size of a batch; their LPIPS is replaced
(its weights are fetched by their constructors) and not reported. Quick hashes: the lookups in hash tables, which
take most of nerfacto's time on a CPU, by our compiled gathering instead of plain torch, to rounding the same."""


def _psnr(row: Row) -> str:
    spread = row["g"].spread()
    return f"{row['g'].mean('psnr'):.2f}" + ("" if spread is None else f" ± {spread:.2f}")


def _memory(row: Row) -> str:
    g = row["g"]
    on_gpu = f" + {g.mean('peak_gpu_gib'):.2f} on the GPU" if "peak_gpu_gib" in g.rows[0] else ""
    return f"{g.mean('peak_gib'):.2f}{on_gpu}"


def _rate(curve: list[dict[str, float]]) -> float:
    """Training rays/s from the first look to the last: without the start, in which nerfacto waits for its batches."""
    first, last = curve[0] if len(curve) > 1 else {"rays": 0, "seconds": 0.0}, curve[-1]
    return (last["rays"] - first["rays"]) / (last["seconds"] - first["seconds"])


GIVEN = {name: method.given for name, method in METHODS.items()}
_COLUMNS = {
    "method": "{g.method}",
    "was given, beside images and poses": lambda r: GIVEN.get(r["g"].method.removesuffix(QUICK), ""),
    "steps": "{g.steps}",
    "M rays": lambda r: f"{r['g'].mean('rays') / 1e6:.2f}",
    "seconds (set up)": lambda r: f"{r['g'].mean('seconds'):.0f} ({r['g'].mean('setup_seconds'):.0f})",
    "processor s": lambda r: f"{r['g'].mean('processor_seconds'):.0f}" if "processor_seconds" in r["g"].rows[0] else "",
    "rays/s": lambda r: f"{np.mean([_rate(x['curve']) for x in r['g'].rows]):.0f}",
    "PSNR": _psnr,
    "SSIM": lambda r: f"{r['g'].mean('ssim'):.3f}",
    "frame, s": lambda r: f"{r['g'].mean('frame_s'):.2f}",
    "peak memory, GiB": _memory,
    "seeds": lambda r: ", ".join(str(x["seed"]) for x in r["g"].rows),
    "trained on": lambda r: r["g"].rows[0].get("gpu", f"{r['g'].rows[0]['threads']} CPU threads"),
}


def _times(groups: list[Group]) -> str:
    """PSNR of every method at equal times."""
    rows: list[Row] = []
    for g in groups:
        at = {f"{t} s": g.curve.at(t) for t in TIMES}
        row = {"": f"{g.method}, {g.steps} steps"} | {t: "" if p is None else f"{p:.2f}" for t, p in at.items()}
        rows.append(row | {"at the end": f"{g.curve.psnr[-1]:.2f} ({g.curve.seconds[-1]:.0f} s)"})
    rendered = [name for name in rows[0] if any(r[name] for r in rows)]
    return table({name: lambda r, name=name: r[name] for name in rendered}, rows)


def draw(path: Path, rows: dict[str, Row]) -> None:
    """PSNR against seconds (left) and rays (right), a row of pictures for each scene and setting."""
    results = tables(rows)
    if not results:
        return
    methods = list(dict.fromkeys(g.method for groups in results.values() for g in groups))
    with figure(path, len(results), 2, (11, 4 * len(results)), sharey="row") as axes:
        for (left, right), ((scene, setting), groups) in zip(axes, results.items(), strict=True):
            for g in groups:
                curve, color = g.curve, f"C{methods.index(g.method) % 10}"
                style = "-" if g.rows[0]["ours"] else "--"
                for axis, x, label in ((left, curve.seconds, f"{g.method}, {g.steps} steps"), (right, curve.rays, "")):
                    axis.plot(x, curve.psnr, style, marker="o", ms=3, color=color, label=label or None)
                    axis.fill_between(x, curve.lowest, curve.highest, color=color, alpha=0.2, lw=0)
            left.set(xscale="log", xlabel="seconds of training", ylabel="PSNR of test views, dB", title=scene)
            right.set(xscale="log", xlabel="training rays")
            right.set_title(setting, fontsize=7)
