"""What ``mmpi-bench train`` found: headline, table and figure, from its rows."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mmpi_ns.bench.provenance import stamp_line
from mmpi_ns.bench.quality.curves import Curve, compare

TIMES = (10, 30, 60, 120, 300, 600, 1200, 1800, 3600)
"""Seconds at which the second table compares."""
QUICK = " (quick hashes)"
"""What follows the name of a peer whose hash tables are looked up by ``peers.look_up_quickly``."""
PEERS = ("nerfacto", "nerfacto" + QUICK, "instant-ngp", "splatfacto")


@dataclass(frozen=True)
class Group:
    """Rows that differ in their seed alone."""

    scene: str
    """Name and size."""
    setting: str
    """Machine and what was looked at: rows of one scene and setting share a table."""
    method: str
    steps: int
    rows: list[dict[str, Any]]

    @property
    def label(self) -> str:
        return f"{self.method}, {self.steps} steps"

    def mean(self, name: str) -> float:
        return float(np.mean([r[name] for r in self.rows]))

    def spread(self, name: str) -> float | None:
        """Standard deviation over seeds; None for one seed."""
        return float(np.std([r[name] for r in self.rows], ddof=1)) if len(self.rows) > 1 else None


def groups(rows: dict[str, Any]) -> list[Group]:
    """All that ran, in the order in which methods were first named."""
    found: dict[tuple[str, str, str, int], Group] = {}
    for key, row in rows.items():
        scene, setting = f"{row['scene']} /{row['downscale_factor']}", _in_words(key.partition("; ")[2])
        where = (scene, setting, row["method"], row["steps"])
        if "not_run" not in row:
            found.setdefault(where, Group(*where, [])).rows.append(row)
    return sorted(found.values(), key=lambda g: (g.scene, g.setting))


def _in_words(setting: str) -> str:
    """0 images stand for all of them."""
    return setting.replace("of 0 images", "of every test image").replace(", 0 whole", ", all whole at the end")


def headline(rows: dict[str, Any]) -> dict[str, float]:
    """Finite figures by name; a scene's name leads where there are several scenes, settings or devices."""
    tables: dict[tuple[str, str], list[Group]] = {}
    for g in groups(rows):
        tables.setdefault((g.scene, g.setting), []).append(g)
    found: dict[str, float] = {}
    for scene, setting in tables:
        prefix = _slug(scene) + "_" if len({s for s, _ in tables}) > 1 else ""
        prefix += _slug(setting) + "_" if sum(s == scene for s, _ in tables) > 1 else ""
        found |= {prefix + k: v for k, v in _of_table(tables[scene, setting]).items()}
    return {k: v for k, v in found.items() if math.isfinite(v)}


def _of_table(table: list[Group]) -> dict[str, float]:
    """Figures of one scene. The longest run of a method has its name, shorter ones their steps as well."""
    found: dict[str, float] = {}
    for g in table:
        longest = max(o.steps for o in table if o.method == g.method) == g.steps
        name = _slug(g.method) + ("" if longest else f"_{g.steps}")
        found |= {
            f"{name}_psnr_db": g.mean("psnr"),
            f"{name}_ssim": g.mean("ssim"),
            f"{name}_seconds": g.mean("seconds"),
        }
        spread = g.spread("psnr")
        found |= {} if spread is None else {f"{name}_psnr_spread_db": spread}
    names = [g.method for g in table if g.rows[0]["ours"]]
    if not names:
        return found
    ours = [g for g in table if g.method == ("mmpi-small" if "mmpi-small" in names else names[0])]
    for peer in PEERS:
        theirs = [g for g in table if g.method == peer]
        if theirs:
            longest = max(theirs, key=lambda g: g.steps)
            compared = compare([Curve.of(g.rows) for g in ours], Curve.of(longest.rows), _slug(peer))
            best = max(g.mean("psnr") for g in ours)
            compared["delta_at_end_db"] = best - longest.mean("psnr")
            # The peer that runs everywhere has the plain names.
            named = {k if _slug(peer) in k else f"{_slug(peer)}_{k}": v for k, v in compared.items()}
            found |= compared if peer == "nerfacto" else named
    return found


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def table(content: dict[str, Any]) -> str:
    """The Markdown page."""
    rows = content["rows"]
    lines = [
        "# Error against time and rays",
        "",
        stamp_line(content["made"]),
        "",
        *_PROTOCOL,
        "",
        "![PSNR against seconds and rays](train.png)",
    ]
    found = groups(rows)
    for scene, setting in dict.fromkeys((g.scene, g.setting) for g in found):
        members = [g for g in found if (g.scene, g.setting) == (scene, setting)]
        split = members[0].rows[0]["split"]
        lines += ["", f"## {scene}", ""]
        lines += [f"{split['train']} training and {split['test']} test images, {setting}.", "", _HEADER, _HEADER_LINE]
        lines += [_line(g) for g in members]
        lines += ["", "PSNR (on the way) after so many seconds:", "", *_times(members)]
    lines += _not_run(rows)
    commits = sorted({f"{r['commit']} ({r['date']})" for r in rows.values() if "commit" in r})
    commands = list(dict.fromkeys(r["command"] for r in rows.values() if "command" in r))
    lines += ["", "Rows were made by:", "", *(f"    {c}" for c in commands), "", f"Commits: {', '.join(commits)}."]
    return "\n".join([*lines, "", "Options of each row: `train.json`.", ""])


_PROTOCOL = (
    "All methods train with the same images, sizes and poses and are scored on the scene's test images; cameras are",
    "not optimised. Seconds count from the setting up of the trainer (images read, MPIs placed, kernels compiled) and",
    "not while test images are rendered. PSNR and SSIM are means over whole test images at the end, ± the standard",
    "deviation over seeds; on the way, PSNR is the mean over a fixed draw of pixels of each test image. nerfstudio's",
    "methods run through its own trainer with their own settings but for the size of a batch; their LPIPS is replaced",
    "(its weights are fetched by their constructors) and not reported. Quick hashes: the lookups in hash tables, which",
    "take most of nerfacto's time on a CPU, by our compiled gathering instead of plain torch, to rounding the same.",
)
_HEADER = (
    "| method | steps | M rays | seconds (set up) | rays/s | PSNR | SSIM | frame, s | peak memory, GiB | seeds "
    "| trained on |"
)
_HEADER_LINE = "|---|" + "---|" * 10


def _line(g: Group) -> str:
    spread = g.spread("psnr")
    psnr = f"{g.mean('psnr'):.2f}" + ("" if spread is None else f" ± {spread:.2f}")
    rate = np.mean([_rate(r["curve"]) for r in g.rows])
    memory = f"{g.mean('peak_gib'):.2f}"
    if "peak_gpu_gib" in g.rows[0]:
        memory += f" + {g.mean('peak_gpu_gib'):.2f} on the GPU"
    cells = [
        g.method,
        str(g.steps),
        f"{g.mean('rays') / 1e6:.2f}",
        f"{g.mean('seconds'):.0f} ({g.mean('setup_seconds'):.0f})",
        f"{rate:.0f}",
        psnr,
        f"{g.mean('ssim'):.3f}",
        f"{g.mean('frame_s'):.2f}",
        memory,
        ", ".join(str(r["seed"]) for r in g.rows),
        g.rows[0].get("gpu", f"{g.rows[0]['threads']} CPU threads"),
    ]
    return "| " + " | ".join(cells) + " |"


def _rate(curve: list[dict[str, float]]) -> float:
    """Training rays/s from the first look to the last: without the start, in which nerfacto waits for its batches."""
    first, last = curve[0], curve[-1]
    if first is last:
        return last["rays"] / last["seconds"]
    return (last["rays"] - first["rays"]) / (last["seconds"] - first["seconds"])


def _times(members: list[Group]) -> list[str]:
    curves = {g.label: Curve.of(g.rows) for g in members}
    shown = [t for t in TIMES if any(c.at(t) is not None for c in curves.values())]
    lines = ["| | " + " | ".join(f"{t} s" for t in shown) + " | at the end |", "|---|" + "---|" * (len(shown) + 1)]
    for label, curve in curves.items():
        values = [curve.at(t) for t in shown]
        cells = ["" if v is None else f"{v:.2f}" for v in values]
        lines.append(f"| {label} | {' | '.join([*cells, f'{curve.psnr[-1]:.2f} ({curve.seconds[-1]:.0f} s)'])} |")
    return lines


def _not_run(rows: dict[str, Any]) -> list[str]:
    reasons = dict.fromkeys(
        f"- {r['method']} on {r['scene']}: {r['not_run']}." for r in rows.values() if "not_run" in r
    )
    return ["", "Not run:", "", *reasons] if reasons else []


def draw(path: Path, rows: dict[str, Any]) -> None:
    """PSNR against seconds (left) and rays (right), a row of pictures for each scene and setting."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    found = groups(rows)
    tables = list(dict.fromkeys((g.scene, g.setting) for g in found))
    if not tables:
        return
    figure, axes = plt.subplots(
        len(tables), 2, figsize=(11, 4 * len(tables)), layout="constrained", squeeze=False, sharey="row"
    )
    methods = list(dict.fromkeys(g.method for g in found))
    for (left, right), where in zip(axes, tables, strict=True):
        for g in (g for g in found if (g.scene, g.setting) == where):
            curve, color = Curve.of(g.rows), f"C{methods.index(g.method) % 10}"
            style = "-" if g.rows[0]["ours"] else "--"
            for axis, x in ((left, curve.seconds), (right, curve.rays)):
                axis.plot(x, curve.psnr, style, marker="o", ms=3, color=color, label=g.label)
                axis.fill_between(x, curve.lowest, curve.highest, color=color, alpha=0.2, lw=0)
        left.set(xscale="log", xlabel="seconds of training", ylabel="PSNR of test views, dB", title=where[0])
        right.set(xscale="log", xlabel="training rays", title=where[1])
        right.title.set_fontsize(7)
        for axis in (left, right):
            axis.grid(alpha=0.3)
        left.legend(fontsize=7)
    figure.savefig(path, dpi=110)
    plt.close(figure)
