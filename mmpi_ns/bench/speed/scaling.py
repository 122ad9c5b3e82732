"""``mmpi-bench scaling``: the time of a ray grows with its live samples, memory with the texels that are allocated."""

from __future__ import annotations

import math
import os
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mmpi_ns.bench.apart import answer, run_apart
from mmpi_ns.bench.provenance import fingerprint, read_json, stamp, stamp_line, write_json
from mmpi_ns.bench.speed.dense import _batch as make_batch
from mmpi_ns.bench.speed.dense import _ours as render_rays
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.rendering.sampler import MMPISampler
from mmpi_ns.scene.plan import MPIPlan, ScenePlan
from mmpi_ns.training.touched_adam import TouchedAdam

TRAVEL = 40.0
"""Units over which the MPIs stand, one behind the other; the cameras are among them."""


@dataclass(frozen=True)
class Point:
    """One size of everything."""

    series: str = ""
    mpis: int = 4
    """That face the way the cameras look."""
    elsewhere: int = 0
    """That face the other way: no ray meets them."""
    planes: int = 64
    height: int = 96
    width: int = 256
    rays: int = 1024

    @property
    def name(self) -> str:
        size = f"{self.planes} planes of {self.height} x {self.width}"
        return f"{self.mpis} + {self.elsewhere} MPIs, {size}, {self.rays} rays"

    def plan(self) -> ScenePlan:
        ahead = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        back = ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
        mpis = []
        for k in range(self.mpis + self.elsewhere):
            here = k < self.mpis
            z = TRAVEL * (k + 0.5) / self.mpis - 10 if here else 0.0
            frame = ((0.0, 0.0, z), ahead if here else back, 3.0, (-1.0, 1.0, -0.35, 0.35))
            mpis.append(MPIPlan(str(k), *frame, self.planes, self.height, self.width))
        return ScenePlan(tuple(mpis), None, 1.0, 5.0, "benchmark")


BASE = Point()


def points() -> list[Point]:
    """Series around one point, one thing changed in each."""
    base = BASE
    return [
        *(replace(base, series="planes", planes=n) for n in (16, 32, 64, 128, 256)),
        *(replace(base, series="MPIs met", mpis=n) for n in (1, 2, 4, 8)),
        *(replace(base, series="MPIs not met", elsewhere=n) for n in (0, 4, 12)),
        *(replace(base, series="rays", rays=n) for n in (256, 1024, 4096)),
        *(replace(base, series="texels", height=h, width=w) for h, w in ((48, 128), (96, 256), (192, 512))),
    ]


@dataclass
class Scaling:
    """Training time and memory over planes, MPIs, rays and texels; each point in a process of its own."""

    steps: int = 10
    """Timed steps of each point, after as many untimed ones."""
    threads: int = 0
    """0 for all cores."""
    output: Path = Path("docs/results")
    """Where scaling.json, scaling.md and scaling.png go."""
    work: Path = Path("outputs/scaling")
    """Where logs go."""

    def run(self) -> None:
        made, path = stamp("scaling", self), self.output / "scaling.json"
        threads = made["threads"] = self.threads or os.cpu_count() or 1
        key = f"{fingerprint()} {self.steps} {threads}"
        before = read_json(path)
        rows = before.get("rows", {}) if before.get("key") == key else {}
        content: dict[str, Any] = {"headline": {}, "made": made, "key": key, "rows": rows}
        chosen = points()
        for number, point in enumerate(chosen, 1):
            name = f"{point.series}: {point.name}"
            if name not in rows:
                request = {**asdict(point), "steps": self.steps}
                row = run_apart("mmpi_ns.bench.speed.scaling", request, self.work, threads)
                if "not_run" in row:
                    raise ValueError(f"{name}: {row['not_run']}")
                rows[name] = {**asdict(point), **row}
                write_json(path, content)
            r = rows[name]
            print(f"[{number}/{len(chosen)}] {name}: {r['live']:.0f} live, {r['step_ms']:.0f} ms", flush=True)
        content["headline"] = headline(list(rows.values()))
        write_json(path, content)
        (self.output / "scaling.md").write_text(table(content), encoding="utf-8")
        draw(self.output / "scaling.png", content)
        print(content["headline"])


def measure(request: dict[str, Any], tell: Callable[[str], None]) -> dict[str, float]:
    """One point, in this process.

    Returns:
        Live and kept samples a ray, milliseconds of a step and of its sampler (medians), allocated texels, bytes of
        tables and moments, and how much memory the process gained at most (GiB).
    """
    steps = request["steps"]
    point = Point(**{k: v for k, v in request.items() if k != "steps"})
    torch.manual_seed(0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    field = MMPIField(point.plan(), hidden_width=32, shares_depth=True)
    groups = [{"params": [p], "lr": lr} for p, lr in
              ((field.density, 0.1), (field.features, 0.1), (field.networks.weights, 1e-3))]  # fmt: skip
    optimizer, sampler = TouchedAdam(groups, lr=0.1), MMPISampler()
    found: dict[str, list[float]] = {"step": [], "march": [], "live": [], "kept": []}
    for step in range(2 * steps):
        bundle, target = make_batch(point.rays)
        start = time.perf_counter()
        rgb, _ = render_rays(field, sampler, bundle, step < steps)
        optimizer.zero_grad()
        ((rgb - target) ** 2).mean().backward()
        optimizer.step()
        found["step"].append(time.perf_counter() - start)
        start = time.perf_counter()
        samples, report = sampler(bundle, field=field, threshold=3e-3)
        found["march"].append(time.perf_counter() - start)
        found["live"].append(float(report.live.float().mean()))
        found["kept"].append(float(samples.metadata["valid"].float().sum()) / point.rays)
    tensors = [p.data for p in field.parameters()] + list(field.buffers())
    tensors += [t for state in optimizer.state.values() for t in state.values() if isinstance(t, torch.Tensor)]
    middle = {k: statistics.median(v[steps:]) for k, v in found.items()}
    return {
        "live": middle["live"],
        "kept": middle["kept"],
        "step_ms": 1e3 * middle["step"],
        "march_ms": 1e3 * middle["march"],
        "texels": float(len(field.density)),
        "table_bytes": float(sum(t.numel() * t.element_size() for t in tensors)),
        "threads": float(torch.get_num_threads()),
        "gained_gib": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20,
    }


def fit(x: list[float], y: list[float]) -> tuple[float, float, float]:
    """Slope and offset of the straight line through points, and the share of the variance that it explains."""
    a, b = np.array(x), np.array(y)
    slope, offset = np.polyfit(a, b, 1)
    rest, all_of_it = ((b - slope * a - offset) ** 2).sum(), ((b - b.mean()) ** 2).sum()
    return float(slope), float(offset), float(1 - rest / all_of_it) if all_of_it > 0 else 1.0


def _at_equal_rays(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [r for r in rows if r["rays"] == BASE.rays]


def headline(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Slopes of time over live samples and of memory over texels, with how straight they are."""
    equal = _at_equal_rays(rows)
    live = [r["live"] for r in equal]
    found: dict[str, float] = {}
    for what in ("march", "step"):
        slope, _, straight = fit(live, [1e6 * r[f"{what}_ms"] / r["rays"] for r in equal])
        found |= {f"{what}_ns_per_live_sample": slope, f"{what}_over_live_r2": straight}
    slope, _, straight = fit([r["texels"] for r in rows], [r["table_bytes"] for r in rows])
    found |= {"bytes_per_texel": slope, "bytes_over_texels_r2": straight}
    # Of moments only what was written to takes memory.
    slope, _, straight = fit([r["texels"] for r in equal], [2**30 * r["gained_gib"] for r in equal])
    found |= {"process_bytes_per_texel": slope, "process_bytes_over_texels_r2": straight}
    apart = sorted((r for r in rows if r["series"] == "MPIs not met"), key=lambda r: r["elsewhere"])
    found["march_with_unmet_over_without"] = apart[-1]["march_ms"] / apart[0]["march_ms"]
    found["heads_with_unmet_over_without"] = (apart[-1]["mpis"] + apart[-1]["elsewhere"]) / apart[0]["mpis"]
    many = sorted((r for r in rows if r["series"] == "rays"), key=lambda r: r["rays"])
    found["time_over_rays_exponent"] = math.log(many[-1]["step_ms"] / many[0]["step_ms"]) / math.log(
        many[-1]["rays"] / many[0]["rays"]
    )
    return {k: v for k, v in found.items() if math.isfinite(v)}


def table(content: dict[str, Any]) -> str:
    """The Markdown page."""
    h = content["headline"]
    lines = [
        "# Scaling",
        "",
        stamp_line(content["made"]),
        "",
        "Joint training on made-up rays along a drive. A sample is live where its ray crosses a plane inside the MPI's",
        f"frustum. The sampler's time a ray grows by {h['march_ns_per_live_sample']:.0f} ns a live sample (a line",
        f"explains {100 * h['march_over_live_r2']:.0f} % of the variance at 1,024 rays), a step's by",
        f"{h['step_ns_per_live_sample']:.0f} ns ({100 * h['step_over_live_r2']:.0f} %); memory by "
        f"{h['bytes_per_texel']:.0f} bytes a texel that is allocated, moments included (where they were never written",
        f"they take none: the process gained {h['process_bytes_per_texel']:.0f} bytes a texel, "
        f"{100 * h['process_bytes_over_texels_r2']:.0f} %).",
        f"With {h['heads_with_unmet_over_without']:.0f} times the MPIs, of which the added ones are met by no ray, the",
        f"sampler takes {h['march_with_unmet_over_without']:.2f} times as long.",
        "",
        "![Time over live samples, memory over texels](scaling.png)",
        "",
        "| series | MPIs met + not met | planes | texels of a plane | rays | live a ray | kept a ray "
        "| sampler, us a ray | step, us a ray | M texels | tables and moments, MB | gained by the process, MB |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in content["rows"].values():
        cells = [
            r["series"],
            f"{r['mpis']} + {r['elsewhere']}",
            str(r["planes"]),
            f"{r['height']} x {r['width']}",
            str(r["rays"]),
            f"{r['live']:.0f}",
            f"{r['kept']:.0f}",
            f"{1e3 * r['march_ms'] / r['rays']:.1f}",
            f"{1e3 * r['step_ms'] / r['rays']:.0f}",
            f"{r['texels'] / 1e6:.2f}",
            f"{r['table_bytes'] / 1e6:.0f}",
            f"{1024 * r['gained_gib']:.0f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def draw(path: Path, content: dict[str, Any]) -> None:
    """Time a ray over live samples (at equal rays), and memory over texels, with their lines."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = list(content["rows"].values())
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    equal = _at_equal_rays(rows)

    def us(what: str) -> Callable[[dict[str, Any]], float]:
        return lambda r: 1e3 * r[f"{what}_ms"] / r["rays"]

    panels = (
        (equal, lambda r: r["live"], us("march"), "live samples a ray", "sampler, us a ray"),
        (equal, lambda r: r["live"], us("step"), "live samples a ray", "step, us a ray"),
        (rows, lambda r: r["texels"] / 1e6, lambda r: r["table_bytes"] / 1e6, "M texels", "tables and moments, MB"),
    )
    for axis, (chosen, x, y, along, up) in zip(axes, panels, strict=True):
        slope, offset, _ = fit([x(r) for r in chosen], [y(r) for r in chosen])
        end = max(x(r) for r in chosen)
        axis.plot([0, end], [offset, offset + slope * end], color="0.7", zorder=0)
        for series in dict.fromkeys(r["series"] for r in chosen):
            own = [r for r in chosen if r["series"] == series]
            axis.plot([x(r) for r in own], [y(r) for r in own], "o", label=series, alpha=0.7)
        axis.set(xlabel=along, ylabel=up, xlim=(0, None), ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    answer(measure)
