"""Headline, Markdown and figure of ``mmpi-bench gpu``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from mmpi_ns.bench.provenance import stamp_line


def headline(parts: dict[str, Any]) -> dict[str, float]:
    """Named numbers of all parts that ran; those that are not there were not measured."""
    found: dict[str, Any] = {}
    if "checks" in parts.get("checks", {}):
        found |= {"checks": len(parts["checks"]["checks"]), "failed_checks": parts["checks"]["failed"]}
    operations = parts.get("operations", {})
    if "march" in operations:
        copy = found["copy_gb_per_s"] = operations["copy_gb_per_s"]
        for name, row in operations["march"].items():
            found[f"march_{name.replace(' ', '_')}_gb_per_s"] = row["gb_per_s"]
            found[f"march_{name.replace(' ', '_')}_share_of_copy"] = row["gb_per_s"] / copy
    for route, prefix in (("triton", ""), ("torch", "torch_")):
        rows = [r for r in parts.get(f"training {route}", {}).values() if isinstance(r, dict)]
        if rows:
            found[f"{prefix}rays_per_s"] = max(r["rays_per_s"] for r in rows)
            found[f"{prefix}peak_gib"] = rows[0].get("peak_gib")
            names = ("frame_ms", "full_frame_ms", "psnr_delta_db", "launches_a_step", "waits_a_step")
            found |= {f"{prefix}{name}": rows[0].get(name) for name in names}
    kitti = parts.get("kitti", {})
    for reading in ("split", "all"):
        if reading in kitti:
            row = kitti[reading]
            found[f"kitti_{reading}_steps_per_s"] = row["steps_per_s"]
            found[f"kitti_{reading}_minutes_of_40000_steps"] = row["minutes_of_40000_steps"]
            found[f"kitti_{reading}_peak_gib"] = row.get("peak_gib")
    for name, row in parts.get("quality", {}).get("methods", {}).items():
        if row.get("curve"):
            best = max(row["curve"], key=lambda point: point["psnr"])
            found |= {f"{name}_psnr_db": best["psnr"], f"{name}_seconds": best["seconds"]}
    return {k: v for k, v in found.items() if isinstance(v, int | float) and math.isfinite(v)}


def table(content: dict[str, Any]) -> str:
    """The Markdown page."""
    parts, device = content["parts"], "no part has run"
    for part in parts.values():
        device = part.get("device", device)
    lines = ["# On a GPU", "", f"{device}. {stamp_line(content['made'])}", ""]
    if content["rehearsal"]:
        lines += ["**A rehearsal in miniature on a CPU: no number here is a measurement.**", ""]
    for name, part in parts.items():
        lines += [f"## {name[0].upper()}{name[1:]} ({part['wall_s']:.0f} s)", ""]
        if "not_run" in part:
            lines += [f"Not run: {part['not_run']}", ""]
        lines += [*_SECTIONS[name.split()[0]](part), ""]
    lines += ["## Headline", "", "| | |", "|---|---|"]
    return "\n".join([*lines, *(f"| {k} | {_number(v)} |" for k, v in content["headline"].items()), ""])


def _number(value: Any) -> str:
    if not isinstance(value, int | float):
        return "-" if value is None else str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def _rows(rows: dict[str, dict[str, Any]], first: str) -> list[str]:
    """A table of rows with equal columns."""
    names = list(dict.fromkeys(k for row in rows.values() for k in row))
    lines = [f"| {first} | " + " | ".join(n.replace("_", " ") for n in names) + " |", "|---" * (len(names) + 1) + "|"]
    return lines + [f"| {k} | " + " | ".join(_number(r.get(n)) for n in names) + " |" for k, r in rows.items()]


def _checks(part: dict[str, Any]) -> list[str]:
    rows = part.get("checks", [])
    lines = [f"{len(rows)} comparisons with float64, {part.get('failed', 0)} failed.", ""]
    lines += ["| comparison | error | bound | |", "|---|---|---|---|"]
    for r in rows:
        lines.append(f"| {r['name']} | {_number(r['error'])} | {_number(r['bound'])} | {'ok' if r['ok'] else 'FAIL'} |")
    return lines


def _operations(part: dict[str, Any]) -> list[str]:
    if "march" not in part:
        return []
    return [
        f"A copy within the device moves {part['copy_gb_per_s']:.0f} GB/s, read and written. The march looks up every",
        "live sample of 4 MPIs of 256 planes, one sector (32 bytes) in each of two rows of texels; 16 of the 64 bytes",
        "are used.",
        "",
        *_rows(part["march"], "rays"),
        "",
        *_rows(part["ops"], "operation"),
    ]


def _training(part: dict[str, Any]) -> list[str]:
    rows = {k: v for k, v in part.items() if isinstance(v, dict)}
    return ["`mmpi`, four MPIs by hand, 256 planes, trained together.", "", *_rows(rows, "a step")] if rows else []


def _kitti(part: dict[str, Any]) -> list[str]:
    lines = []
    for reading in ("split", "all"):
        if reading in part:
            row = dict(part[reading])
            stages = row.pop("step_ms")
            lines += [f"`rays-per-mpi {reading}`: " + ", ".join(f"{k} {_number(v)}" for k, v in row.items()) + ".", ""]
            lines += ["| stage | ms a step |", "|---|---|", *(f"| {k} | {_number(v)} |" for k, v in stages.items()), ""]
    return lines


def _quality(part: dict[str, Any]) -> list[str]:
    lines = ["| method | PSNR at the end | s | curve (s: dB) |", "|---|---|---|---|"]
    for name, row in part.get("methods", {}).items():
        curve = row.get("curve") or []
        points = ", ".join(f"{p['seconds']:.0f}: {p['psnr']:.2f}" for p in curve)
        end = curve[-1] if curve else {}
        said = points or f"not run: {row.get('not_run')}"
        lines.append(f"| {name} | {_number(end.get('psnr'))} | {_number(end.get('seconds'))} | {said} |")
    return lines


_SECTIONS = {
    "checks": _checks,
    "operations": _operations,
    "training": _training,
    "kitti": _kitti,
    "quality": _quality,
}


def draw(path: Path, quality: dict[str, Any]) -> None:
    """PSNR against seconds, one line a method; nothing where none was trained."""
    curves = {k: r["curve"] for k, r in quality.get("methods", {}).items() if r.get("curve")}
    if not curves:
        return
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for name, curve in curves.items():
        axes.plot([max(p["seconds"], 0.1) for p in curve], [p["psnr"] for p in curve], marker="o", label=name)
    axes.set(
        xscale="log", xlabel="seconds of training, placement and loading included", ylabel="PSNR of test views, dB"
    )
    axes.legend()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
