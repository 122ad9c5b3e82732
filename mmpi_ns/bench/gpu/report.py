"""Headline, Markdown and figure of ``mmpi-bench gpu``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mmpi_ns.bench.report import Row, figure, page, table, title


def headline(parts: Row) -> dict[str, float]:
    """Named numbers of all parts that ran; those that are not there were not measured."""
    found: Row = {}
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
    return {k: v for k, v in found.items() if v is not None}


def markdown(content: Row, head: Row) -> str:
    """The page."""
    parts, device = content["rows"], "no part has run"
    for part in parts.values():
        device = part.get("device", device)
    blocks = [f"On: {device}."]
    if content["rehearsal"]:
        blocks.append("**A rehearsal in miniature on a CPU: no number here is a measurement.**")
    for name, part in parts.items():
        blocks += [f"## {title(name)} ({part['wall_s']:.0f} s)"]
        blocks += [f"Not run: {part['not_run']}"] if "not_run" in part else []
        blocks += _SECTIONS[name.split()[0]](part)
    numbers = ({"name": name, "value": _number(value)} for name, value in head.items())
    blocks += ["## Headline", table({"": "{name}", "value": "{value}"}, numbers)]
    return page("On a GPU", content["made"], blocks)


def _number(value: Any) -> str:
    if not isinstance(value, int | float):
        return "-" if value is None else str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def _all_columns(rows: dict[str, Row], first: str) -> str:
    """A table of everything in the rows."""
    names = dict.fromkeys(k for row in rows.values() for k in row)
    columns = {first: lambda r: r["row"]} | {n.replace("_", " "): lambda r, n=n: _number(r.get(n)) for n in names}
    return table(columns, ({"row": name, **row} for name, row in rows.items()))


def _checks(part: Row) -> list[str]:
    rows = part.get("checks", [])
    columns = {"comparison": "{name}", "error": lambda r: _number(r["error"]), "bound": lambda r: _number(r["bound"])}
    columns |= {"": lambda r: "ok" if r["ok"] else "FAIL"}
    said = f"{len(rows)} comparisons with float64, {part.get('failed', 0)} failed."
    return [said, table(columns, rows)]


def _operations(part: Row) -> list[str]:
    if "march" not in part:
        return []
    said = f"""\
A copy within the device moves {part["copy_gb_per_s"]:.0f} GB/s, read and written. The march looks up every live sample
of 4 MPIs of 256 planes, one sector (32 bytes) in each of two rows of texels; 16 of the 64 bytes are used."""
    return [said, _all_columns(part["march"], "rays"), _all_columns(part["ops"], "operation")]


def _training(part: Row) -> list[str]:
    rows = {k: v for k, v in part.items() if isinstance(v, dict)}
    return ["`mmpi`, four MPIs by hand, 256 planes, trained together.", _all_columns(rows, "a step")] if rows else []


def _kitti(part: Row) -> list[str]:
    blocks = []
    for reading in (r for r in ("split", "all") if r in part):
        facts = ", ".join(f"{k} {_number(v)}" for k, v in part[reading].items() if k != "step_ms")
        stages = {name: {"ms a step": ms} for name, ms in part[reading]["step_ms"].items()}
        blocks += [f"`rays-per-mpi {reading}`: {facts}.", _all_columns(stages, "stage")]
    return blocks


def _quality(part: Row) -> list[str]:
    rows = {}
    for name, row in part.get("methods", {}).items():
        curve = row.get("curve") or []
        said = ", ".join(f"{p['seconds']:.0f}: {p['psnr']:.2f}" for p in curve)
        end = curve[-1] if curve else {}
        rows[name] = {"PSNR at the end": end.get("psnr"), "s": end.get("seconds")}
        rows[name]["curve (s: dB)"] = said or f"not run: {row.get('not_run')}"
    return [_all_columns(rows, "method")]


_SECTIONS = {
    "checks": _checks,
    "operations": _operations,
    "training": _training,
    "kitti": _kitti,
    "quality": _quality,
}


def draw(path: Path, quality: Row) -> None:
    """PSNR against seconds, one line a method; nothing where none was trained."""
    curves = {k: r["curve"] for k, r in quality.get("methods", {}).items() if r.get("curve")}
    if not curves:
        return
    with figure(path, 1, 1, (6, 4)) as ((axis,),):
        for name, curve in curves.items():
            axis.plot([max(p["seconds"], 0.1) for p in curve], [p["psnr"] for p in curve], marker="o", label=name)
        along = "seconds of training, placement and loading included"
        axis.set(xscale="log", xlabel=along, ylabel="PSNR of test views, dB")
