"""Training rays a second beside a plain dense evaluation of all K x L planes of the same field."""

from __future__ import annotations

import json
import multiprocessing
import resource
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.field_components.field_heads import FieldHeadNames
from torch import Tensor

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.compositing import composite_weights, render_colors
from mmpi_ns.ops.interpolate import interpolate_reference
from mmpi_ns.rendering.sampler import MMPISampler
from mmpi_ns.scene.geometry import inverse_distance, plane_hits, sample_disparity
from mmpi_ns.scene.plan import MPIPlan, ScenePlan
from mmpi_ns.training.touched_adam import TouchedAdam


@dataclass
class Dense:
    """Steps of a joint training on K = 4 MPIs of 64 planes of 96 x 256 with 1,024 rays: ours and plain dense."""

    output: Path = Path("docs/results")
    """Where dense.json and dense.md go."""
    steps: int = 30
    """Timed steps of each path, after as many untimed ones (densities sharpen, which ours profits from)."""
    rays: int = 1024
    """Rays a step."""

    def run(self) -> None:
        context = multiprocessing.get_context("spawn")  # a fresh process each: peak memory only ever rises
        rows: dict[str, Any] = {}
        for name in ("ours", "dense"):
            with context.Pool(1) as pool:
                rows[name] = pool.apply(measure, (name, self.steps, self.rays))
        ratio = rows["dense"]["step_ms"] / rows["ours"]["step_ms"]
        headline = {
            "rays_per_s": rows["ours"]["rays_per_s"],
            "dense_rays_per_s": rows["dense"]["rays_per_s"],
            "ratio": ratio,
        }
        self.output.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"headline": headline, "rows": rows, "threads": torch.get_num_threads()}, indent=1)
        (self.output / "dense.json").write_text(text, encoding="utf-8")
        lines = [
            "# Cost follows live samples",
            "",
            f"`python -m mmpi_ns.bench dense`, {torch.get_num_threads()} threads.",
            "",
        ]
        lines += ["| path | ms a step (median) | rays/s | peak memory, GiB | samples a ray |", "|---|---|---|---|---|"]
        for name, r in rows.items():
            cells = f"{r['step_ms']:.0f} | {r['rays_per_s']:.0f} | {r['peak_gib']:.2f} | {r['samples']:.0f}"
            lines.append(f"| {name} | {cells} |")
        lines += ["", f"Ours takes 1/{ratio:.1f} of the time of the dense evaluation of the same planes.", ""]
        (self.output / "dense.md").write_text("\n".join(lines), encoding="utf-8")
        print("\n".join(lines))


def measure(name: str, steps: int, num_rays: int) -> dict[str, float]:
    """Medians over timed steps of one path, in this process."""
    torch.manual_seed(0)
    field = MMPIField(_plan(), hidden_width=32, shares_depth=True)
    params = [field.density, field.features, field.networks.weights]
    rates = (0.1, 0.1, 1e-3)
    groups = [{"params": [p], "lr": lr} for p, lr in zip(params, rates, strict=True)]
    optimizer = TouchedAdam(groups, lr=0.1) if name == "ours" else torch.optim.Adam(groups, betas=(0.9, 0.99))
    sampler = MMPISampler()
    times, samples = [], 0.0
    for step in range(2 * steps):
        bundle, target = _batch(num_rays)
        start = time.perf_counter()
        rgb, samples = _ours(field, sampler, bundle, step < steps) if name == "ours" else _dense(field, bundle)
        optimizer.zero_grad()
        ((rgb - target) ** 2).mean().backward()
        optimizer.step()
        times.append(time.perf_counter() - start)
    step_s = statistics.median(times[steps:])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"step_ms": 1e3 * step_s, "rays_per_s": num_rays / step_s, "peak_gib": peak, "samples": samples}


def _plan() -> ScenePlan:
    """Four MPIs that stand 10 units apart on a drive and face the same way."""
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    mpis = [
        MPIPlan(str(k), (0.0, 0.0, 10.0 * k - 5), axes, 3.0, (-1.0, 1.0, -0.35, 0.35), 64, 96, 256) for k in range(4)
    ]
    return ScenePlan(tuple(mpis), None, 1.0, 5.0, "benchmark")


def _batch(count: int) -> tuple[RayBundle, Tensor]:
    """Rays of cameras along the drive, and a smooth target with a surface at some depth."""
    origins = torch.rand(count, 3) * torch.tensor([0.2, 0.2, 35.0])
    directions = torch.cat(
        [torch.rand(count, 2) * torch.tensor([1.6, 0.5]) - torch.tensor([0.8, 0.25]), torch.ones(count, 1)], -1
    )
    directions = torch.nn.functional.normalize(directions, dim=-1)
    target = 0.5 + 0.5 * torch.sin(20 * directions + origins[:, 2:] / 10)
    one = torch.ones(count, 1)
    return RayBundle(origins, directions, one, nears=one, fars=one * torch.inf), target


def _ours(field: MMPIField, sampler: MMPISampler, bundle: RayBundle, young: bool) -> tuple[Tensor, float]:
    share = 0.1 if young else float("inf")
    samples, report = sampler(bundle, field=field, threshold=3e-3, fair_share=share)
    tau, lookup = field.get_density(samples)
    colors = field.get_outputs(samples, lookup)[FieldHeadNames.RGB]
    meta = samples.metadata
    weights = composite_weights(
        tau[..., 0], meta["valid"][..., 0], meta["skipped_before"][..., 0], report.skipped_total
    )
    return render_colors(weights, colors) + 0.5 * weights.transmittance, float(report.live.float().mean())


def _dense(field: MMPIField, bundle: RayBundle) -> tuple[Tensor, float]:
    """Every plane of every MPI for every ray, one sort, colours wherever alpha exceeds 1e-4, dense gradients."""
    assert bundle.nears is not None and bundle.fars is not None
    hits = plane_hits(bundle.origins, bundle.directions, bundle.nears, bundle.fars, field.frames)
    taus, keys, colors = [], [], []
    count = len(bundle)
    for k, mpi in enumerate(field.plan.mpis):
        m = torch.arange(mpi.planes - 1, -1, -1).expand(count, -1)
        w = sample_disparity(m, field.frames.disparity_steps[k], field.frames.last_disparities[k])
        live = (m <= hits.m_first[:, k : k + 1]) & (m > (hits.m_first - hits.count)[:, k : k + 1])
        u0, u1, v0, v1 = mpi.extent
        u = (hits.u[:, k, :1] + w * hits.u[:, k, 1:] - u0) * (2 / (u1 - u0)) - 1
        v = (hits.v[:, k, :1] + w * hits.v[:, k, 1:] - v0) * (2 / (v1 - v0)) - 1
        ndc = torch.stack([u, v, 1 - 2 * mpi.near / mpi.depth_share * (w - mpi.last_disparity)], -1).reshape(-1, 3)
        planes = (mpi.planes - 1 - m).reshape(-1)
        rows, weights = field.grids[k].bilinear(planes, ndc)
        raw = interpolate_reference(field.density, rows, weights)[:, 0]
        tau = torch.where(live.reshape(-1), field.mpi_tau(k, raw, planes), 0.0)
        chosen = (tau > 1e-4).nonzero()[:, 0]
        features = interpolate_reference(field.features, rows[chosen], weights[chosen])
        local = hits.local_directions[:, k].repeat_interleave(mpi.planes, 0)[chosen]
        color = field.networks(k, features, ndc[chosen], local)
        colors.append(torch.zeros(tau.shape[0], 3).index_put((chosen,), color).view(count, -1, 3))
        taus.append(tau.view(count, -1))
        oz, dz = hits.local_origins[:, k, 2:], hits.local_directions[:, k, 2:]
        keys.append(torch.where(live, inverse_distance(w, oz, dz), -1.0))
    order = torch.sort(torch.cat(keys, -1), dim=-1, descending=True, stable=True)[1]
    tau = torch.cat(taus, -1).gather(-1, order)
    color = torch.cat(colors, 1).gather(1, order[..., None].expand(-1, -1, 3))
    zero = torch.zeros_like(tau)
    result = composite_weights(tau, tau > 0, zero, zero[:, :1])
    return render_colors(result, color) + 0.5 * result.transmittance, float(tau.shape[1])
