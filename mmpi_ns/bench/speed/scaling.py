"""``mmpi-bench scaling``: the time of a ray grows with its live samples, memory with the texels that are allocated."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.bench.apart import Tell, run_apart
from mmpi_ns.bench.rendering import AHEAD, render
from mmpi_ns.bench.report import Bench, Report, Row, figure, page, table
from mmpi_ns.bench.speed.all_planes import rates_of, render_densely
from mmpi_ns.bench.trainers import peak_gib
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.samples import metadata_of
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
        return f"{self.series}: {self.mpis} + {self.elsewhere} MPIs, {size}, {self.rays} rays"

    def plan(self) -> ScenePlan:
        back = ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
        frames = [((0.0, 0.0, TRAVEL * (k + 0.5) / self.mpis - 10), AHEAD) for k in range(self.mpis)]
        frames += [((0.0, 0.0, 0.0), back)] * self.elsewhere
        size = (3.0, (-1.0, 1.0, -0.35, 0.35), self.planes, self.height, self.width)
        return ScenePlan(tuple(MPIPlan(str(k), *f, *size) for k, f in enumerate(frames)), None, 1.0, 5.0, "benchmark")


BASE = Point()


def points() -> list[Point]:
    """Series around one point, one thing changed in each."""
    return [
        *(replace(BASE, series="planes", planes=n) for n in (16, 32, 64, 128, 256)),
        *(replace(BASE, series="MPIs met", mpis=n) for n in (1, 2, 4, 8)),
        *(replace(BASE, series="MPIs not met", elsewhere=n) for n in (0, 4, 12)),
        *(replace(BASE, series="rays", rays=n) for n in (256, 1024, 4096)),
        *(replace(BASE, series="texels", height=h, width=w) for h, w in ((48, 128), (96, 256), (192, 512))),
    ]


def made_up_batch(count: int, image: bool = False) -> tuple[RayBundle, Tensor]:
    """Rays of cameras along the drive, or of one ``image``, and a smooth target with a surface at some depth."""
    if image:
        side = torch.linspace(0, 1, max(1, round(count**0.5)))
        places = torch.stack(torch.meshgrid(side, side, indexing="xy"), -1).reshape(-1, 2)
        origins = torch.tensor([0.1, 0.1, 12.0]).expand(len(places), 3)
    else:
        origins, places = torch.rand(count, 3) * torch.tensor([0.2, 0.2, 35.0]), torch.rand(count, 2)
    tangents, one = places * torch.tensor([1.6, 0.5]) - torch.tensor([0.8, 0.25]), torch.ones(len(places), 1)
    directions = torch.nn.functional.normalize(torch.cat([tangents, one], -1), dim=-1)
    target = 0.5 + 0.5 * torch.sin(20 * directions + origins[:, 2:] / 10)
    return RayBundle(origins, directions, one, nears=one, fars=one * torch.inf), target


def render_ours(field: MMPIField, bundle: RayBundle, young: bool, threshold: float = 3e-3) -> tuple[Tensor, float]:
    """Colours over grey [R, 3] as a training step renders them, and live samples a ray."""
    found = render(field, bundle, threshold, fair_share=0.1 if young else math.inf)
    return found.colors.rgb + 0.5 * found.composite.transmittance, float(found.report.live.float().mean())


def measure(request: dict[str, Any], tell: Tell) -> dict[str, float]:
    """Trains on one point, in this process.

    Args:
        request: the fields of a ``Point``, steps (timed after as many untimed ones, in which densities sharpen), and
            whether all is evaluated densely.
        tell: of progress.

    Returns:
        Live and kept samples a ray, milliseconds of a step and of its sampler (medians), allocated texels, bytes of
        tables and moments, and how much memory the process gained at most and held at most (GiB).
    """
    point = Point(**{k: v for k, v in request.items() if k not in ("steps", "dense")})
    steps, dense = request["steps"], request.get("dense", False)
    torch.manual_seed(0)
    before = peak_gib()
    field, sampler = MMPIField(point.plan(), hidden_width=32, shares_depth=True), MMPISampler()
    groups = rates_of(field)
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99)) if dense else TouchedAdam(groups, lr=0.1)
    rows = []
    for step in range(2 * steps):
        bundle, target = made_up_batch(point.rays)
        start = time.perf_counter()
        rgb, live = render_densely(field, bundle) if dense else render_ours(field, bundle, step < steps)
        optimizer.zero_grad()
        ((rgb - target) ** 2).mean().backward()
        optimizer.step()
        row = {"live": live, "kept": live, "step_ms": 1e3 * (time.perf_counter() - start)}
        start = time.perf_counter()
        if not dense:
            samples = sampler(bundle, field=field, threshold=3e-3)[0]
            row["kept"] = float(metadata_of(samples)["valid"].sum()) / point.rays
        rows.append(row | {"march_ms": 1e3 * (time.perf_counter() - start)})
    tensors = [p.data for p in field.parameters()] + list(field.buffers())
    tensors += [t for state in optimizer.state.values() for t in state.values() if isinstance(t, Tensor)]
    return {
        **{name: statistics.median(r[name] for r in rows[steps:]) for name in rows[0]},
        "texels": float(len(field.density)),
        "table_bytes": float(sum(t.numel() * t.element_size() for t in tensors)),
        "threads": float(torch.get_num_threads()),
        "gained_gib": peak_gib() - before,
        "peak_gib": peak_gib(),
    }


@dataclass
class Scaling(Bench):
    """Training time and memory over planes, MPIs, rays and texels; each point in a process of its own."""

    steps: int = 10
    """Timed steps of each point, after as many untimed ones."""

    name = "scaling"

    def run(self) -> None:
        report, chosen = Report(self, self.key()), points()
        for number, point in enumerate(chosen, 1):
            r = report.row(point.name, lambda point=point: asdict(point) | self._measure(point))
            print(f"[{number}/{len(chosen)}] {point.name}: {r['live']:.0f} live, {r['step_ms']:.0f} ms", flush=True)
        rows = list(report.rows.values())
        head = headline(rows)
        report.finish(head, markdown(rows, head, report.content["made"]), lambda path: draw(path, rows))
        print(head)

    def _measure(self, point: Point) -> Row:
        return run_apart(measure, {**asdict(point), "steps": self.steps}, self.folder, self.cores)


def fit(x: list[float], y: list[float]) -> tuple[float, float, float]:
    """Slope and offset of the straight line through points, and the share of the variance that it explains."""
    a, b = np.array(x), np.array(y)
    slope, offset = np.polyfit(a, b, 1)
    rest, all_of_it = ((b - slope * a - offset) ** 2).sum(), ((b - b.mean()) ** 2).sum()
    return float(slope), float(offset), float(1 - rest / all_of_it) if all_of_it > 0 else 1.0


def headline(rows: list[Row]) -> dict[str, float]:
    """Slopes of time over live samples and of memory over texels, with how straight they are."""
    equal = [r for r in rows if r["rays"] == BASE.rays]
    found: dict[str, float] = {}
    for what in ("march", "step"):
        per_ray = [1e6 * r[f"{what}_ms"] / r["rays"] for r in equal]
        slope, _, straight = fit([r["live"] for r in equal], per_ray)
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
    growth = math.log(many[-1]["step_ms"] / many[0]["step_ms"])
    return found | {"time_over_rays_exponent": growth / math.log(many[-1]["rays"] / many[0]["rays"])}


def markdown(rows: list[Row], h: dict[str, float], made: Row) -> str:
    """The page."""
    columns = {
        "series": "{series}",
        "MPIs met + not met": "{mpis} + {elsewhere}",
        "planes": "{planes}",
        "texels of a plane": "{height} x {width}",
        "rays": "{rays}",
        "live a ray": "{live:.0f}",
        "kept a ray": "{kept:.0f}",
        "sampler, us a ray": lambda r: f"{1e3 * r['march_ms'] / r['rays']:.1f}",
        "step, us a ray": lambda r: f"{1e3 * r['step_ms'] / r['rays']:.0f}",
        "M texels": lambda r: f"{r['texels'] / 1e6:.2f}",
        "tables and moments, MB": lambda r: f"{r['table_bytes'] / 1e6:.0f}",
        "gained by the process, MB": lambda r: f"{1024 * r['gained_gib']:.0f}",
    }
    said = f"""\
Joint training on made-up rays along a drive. A sample is live where its ray crosses a plane inside the MPI's
frustum. The sampler's time a ray grows by {h["march_ns_per_live_sample"]:.0f} ns a live sample (a line explains
{100 * h["march_over_live_r2"]:.0f} % of the variance at 1,024 rays), a step's by {h["step_ns_per_live_sample"]:.0f} ns
({100 * h["step_over_live_r2"]:.0f} %); memory by {h["bytes_per_texel"]:.0f} bytes a texel that is allocated, moments
included (where they were never written they take none: the process gained {h["process_bytes_per_texel"]:.0f} bytes a
texel, {100 * h["process_bytes_over_texels_r2"]:.0f} %). With {h["heads_with_unmet_over_without"]:.0f} times the MPIs,
of which the added ones are met by no ray, the sampler takes {h["march_with_unmet_over_without"]:.2f} times as long."""
    picture = "![Time over live samples, memory over texels](scaling.png)"
    return page("Scaling", made, said, picture, table(columns, rows))


def draw(path: Path, rows: list[Row]) -> None:
    """Time a ray over live samples (at equal rays), and memory over texels, with their lines."""
    equal = [r for r in rows if r["rays"] == BASE.rays]
    for r in rows:
        r |= {f"{what}_us": 1e3 * r[f"{what}_ms"] / r["rays"] for what in ("march", "step")}
        r |= {"m_texels": r["texels"] / 1e6, "mb": r["table_bytes"] / 1e6}
    panels = (
        (equal, "live", "march_us", "live samples a ray", "sampler, us a ray"),
        (equal, "live", "step_us", "live samples a ray", "step, us a ray"),
        (rows, "m_texels", "mb", "M texels", "tables and moments, MB"),
    )
    with figure(path, 1, 3, (13, 4)) as (axes,):
        for axis, (chosen, x, y, along, up) in zip(axes, panels, strict=True):
            slope, offset, _ = fit([r[x] for r in chosen], [r[y] for r in chosen])
            end = max(r[x] for r in chosen)
            axis.plot([0, end], [offset, offset + slope * end], color="0.7", zorder=0)
            for series in dict.fromkeys(r["series"] for r in chosen):
                own = [r for r in chosen if r["series"] == series]
                axis.plot([r[x] for r in own], [r[y] for r in own], "o", label=series, alpha=0.7)
            axis.set(xlabel=along, ylabel=up, xlim=(0, None), ylim=(0, None))
