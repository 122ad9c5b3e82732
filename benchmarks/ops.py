"""Each operation of a step against the bytes and sums that it cannot do without."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from gpu_parts import copy_rate
from lab import SceneBench, figure, median_s
from methods import METHODS
from report import Report, Row, page, slug, table, title
from torch import Tensor
from trainers import Steps

from mmpi_ns.field.tables import Lookup
from mmpi_ns.model import MMPIModel
from mmpi_ns.ops.composite import composite_weights
from mmpi_ns.ops.interpolate import Table, index_rows, read_rows, sum_rows, weigh_rows
from mmpi_ns.ops.march import MergedSamples
from mmpi_ns.rendering.rendered import bounded
from mmpi_ns.sampler import march, march_options, merge, rays_of
from mmpi_ns.scripts.command import run

COPIED = 1 << 26
"""Numbers copied to measure bandwidth: 256 MiB, beyond any cache."""


@dataclass(frozen=True)
class Op:
    """One operation on a training batch."""

    name: str
    work: Callable[[], Any]
    bytes_: float
    """That it must at least move: every number that it reads or writes, once."""
    flops: float = 0.0
    """Multiplications and additions that it must do."""


@dataclass
class Ops(SceneBench):
    """Milliseconds of each operation of a training step, beside what bandwidth and arithmetic would allow.

    The limit of an operation is its bytes (each number that it reads or writes counts once, however often it is looked
    up) over the bandwidth of a copy, or its sums over the rate of a matrix product, whichever takes longer.
    """

    early: int = 40
    """Steps before the first measurement, while resolution grows."""
    steps: int = 600
    """Steps of the whole training; measured again after the last."""
    rays: int = 1024
    """Pixel rays of a step."""
    repeats: int = 5
    """Times that each operation runs; the median counts."""

    name = "ops"

    def run(self) -> None:
        if not 0 < self.early < self.steps:
            raise ValueError(f"--early {self.early}: give a number between 0 and --steps ({self.steps}).")
        report = Report(self, self.key())
        if not {"limits", "early", "late"} <= set(report.rows):
            report.rows.update(self._measure())
        head = headline(report.rows)
        text = markdown(report.rows, report.content["made"])
        report.finish(head, text, lambda path: draw(path, report.rows))
        print(head)

    def _measure(self) -> dict[str, Row]:
        if self.threads:
            torch.set_num_threads(self.threads)
        device = "cuda" if torch.cuda.is_available() else "cpu"
        steps = Steps(METHODS["mmpi-small"].words(self.scene, self.folder, self.steps, self.rays, 0, device))
        limits = {"copy_gb_per_s": copy_rate(device, COPIED) / 1e9, "matmul_gflop_per_s": matmul_rate(device) / 1e9}
        print(limits, flush=True)
        rows: dict[str, Row] = {"limits": limits}
        for name, count in (("early", self.early), ("late", self.steps - self.early)):
            step_ms = 1e3 * steps.run(count) / count
            rows[name] = {**measure(steps, self.repeats, limits), "step_ms": step_ms}
        return rows


def matmul_rate(device: str) -> float:
    """Multiplications and additions a second of a large product in float32."""
    a = torch.rand(2048, 2048, device=device)
    return 2 * 2048**3 / median_s(lambda: a @ a, 5)


def measure(steps: Steps, repeats: int, limits: dict[str, float]) -> Row:
    """All operations on the batch of the next step, each beside the milliseconds that it takes at least."""
    model = steps.pipeline.model
    assert isinstance(model, MMPIModel)
    ops, counts = operations(model.train(), steps)
    rows: dict[str, Row] = {}
    for op in ops:
        assert op.name not in rows, f"two operations are called {op.name}"
        row = {"ms": 1e3 * median_s(op.work, repeats), "mb": op.bytes_ / 1e6, "mflop": op.flops / 1e6}
        rows[op.name] = row | {"limit_ms": limit_ms(row, limits)}
        print(f"{op.name}: {row['ms']:.2f} ms", flush=True)
    return {"ops": rows, "counts": counts}


def limit_ms(row: Row, limits: dict[str, float]) -> float:
    """Milliseconds that an operation takes at least."""
    return max(row["mb"] / limits["copy_gb_per_s"], row["mflop"] / limits["matmul_gflop_per_s"])


def operations(model: MMPIModel, steps: Steps) -> tuple[list[Op], dict[str, float]]:
    """The operations of a training step on one batch, and how much there is of everything."""
    bundle, batch = steps.pipeline.datamanager.next_train(steps.step)
    field = model.field
    bundle = bounded(bundle, field.plan)

    def sample():
        forming = not model.progress.schedule.sharpened(model.progress.step)
        options = march_options(model.config.sampling, field.plan, forming, blends=False)
        return march(field.layout, field.tables, rays_of(bundle), options)

    samples = sample()
    lookup = field._lookup(bundle, samples)
    intersected, kept = float(samples.num_intersected.sum()), float(len(samples.heads))
    channels, rows, taps = field.feature_channels, float(len(lookup.rows)), lookup.taps
    counts = {
        "rays": len(bundle),
        "intersected": intersected,
        "kept": kept,
        "rows": rows,
        "pixels": len(batch["indices"]),
    }
    kept_bytes = 2 * 8 + 3 * 4 + 3 * 4  # head and plane, position, distance and depths
    ops = [
        Op("march: look up, merge, keep", sample, intersected * 4 * 4 + kept * kept_bytes),
        _sort(samples.num_intersected),
        _index(lookup.rows[taps.positions], len(field.density), rows),
    ]
    ops += _interpolation(field, lookup, channels)
    ops += _shading(field, bundle, samples, lookup)
    ops.append(_variation(field, lookup, rows * (1 + channels) * 2 * 4))
    ops.append(_adam(steps, rows * (1 + channels) * 7 * 4))
    return ops, counts


def _sort(intersected: Tensor) -> Op:
    """Merging by one stable sort, as the plain path does (the compiled march merges as it goes)."""
    count = int(intersected.sum())
    rays = torch.repeat_interleave(torch.arange(len(intersected), device=intersected.device), intersected)
    keys = torch.rand(count, generator=torch.Generator().manual_seed(0)).to(intersected.device)
    return Op("merge by a sort", lambda: merge(rays, keys), count * (8 + 4 + 8))


def _index(rows: Tensor, table_rows: int, distinct: float) -> Op:
    return Op("index of rows", lambda: index_rows(rows, table_rows), rows.numel() * (8 + 4) + distinct * 8)


def _interpolation(field: Any, lookup: Lookup, channels: int) -> list[Op]:
    """Features of the kept samples from the distinct rows, and back."""
    position, weights, rows = lookup.taps.positions, lookup.taps.weights, lookup.rows
    table, features = len(rows) * channels * 4, lookup.features.detach()
    moved = position.numel() * (position.element_size() + 4) + table + len(position) * channels * 4
    grad = torch.rand(len(position), channels, device=weights.device)
    return [
        Op("gather rows", lambda: read_rows(field.features, rows), len(rows) * 8 + 2 * table),
        Op("interpolation", lambda: weigh_rows(features, position, weights), moved),
        Op("interpolation, backward", lambda: sum_rows(position, grad, weights, len(rows)), moved),
    ]


def _shading(field: Any, rays: Any, samples: MergedSamples, lookup: Lookup) -> list[Op]:
    """Weights of the samples, and what rays show by them: forwards, and back to texels and depths."""
    of_rays = (samples.starts, samples.skipped_before, samples.skipped_total)
    tau, features = samples.tau.clone().requires_grad_(), lookup.features.detach().requires_grad_()
    lookup = replace(lookup, density=lookup.density.detach(), features=features)
    fixed = composite_weights(tau.detach(), *of_rays)

    def weigh() -> Tensor:
        return composite_weights(tau, *of_rays).weights

    def show() -> Tensor:
        return field.render_colors(rays, samples, lookup, fixed)[0]

    def back(work: Callable[[], Tensor]) -> None:
        work().sum().backward()
        tau.grad = features.grad = field.networks.weights.grad = None

    asked = len(rays) if field.shading == "ray" else len(tau)
    sums = 2.0 * sum(math.prod(s) for s in field.networks.shapes[::2]) * asked
    depths, read = len(tau) * (4 + 4 + 4), features.numel() * 4 + len(tau) * 4 * (4 + 4)
    return [
        Op("compositing", weigh, depths),
        Op("compositing, and backward", partial(back, weigh), 2 * depths),
        Op("colours of rays", show, read, sums),
        Op("colours of rays, and backward", partial(back, show), 2 * read, 3 * sums),
    ]


def _variation(field: Any, lookup: Lookup, moved: float) -> Op:
    def work() -> None:
        # The rows are gathered again each time: what a backward pass went through is gone.
        density, features = (read_rows(t, lookup.rows) for t in (field.density, field.features))
        fresh = replace(lookup, density=density, features=features)
        field.total_variation(fresh, 1e-5, 1e-6).backward()
        field.density.grad = field.features.grad = None

    return Op("total variation, forward and backward", work, moved)


def _adam(steps: Steps, moved: float) -> Op:
    """The optimisers' step with the gradients of one batch; restores nothing: some more steps do no harm."""
    optimizers = list(steps.trainer.optimizers.optimizers.values())
    _, losses, _ = steps.pipeline.get_train_loss_dict(step=steps.step)
    for optimizer in optimizers:
        optimizer.zero_grad()
    torch.stack([loss.reshape(()) for loss in losses.values()]).sum().backward()

    params = [p for o in optimizers for group in o.param_groups for p in group["params"] if p.grad is not None]
    grads = [(p, getattr(p, "grad_rows", None), p.grad) for p in params]

    def work() -> None:
        for p, rows, grad in grads:
            p.grad = None
            if isinstance(p, Table):
                assert rows is not None
                p.add_grad(rows, grad)
            else:
                p.grad = grad
        for optimizer in optimizers:
            optimizer.step()
        for p in params:
            p.grad = None  # other operations have gradients of their own

    for p in params:
        p.grad = None
    return Op("Adam", work, moved)


def headline(rows: dict[str, Row]) -> dict[str, float]:
    """Rates of the machine, and of each operation its milliseconds and the share of its limit that it reaches."""
    results: dict[str, float] = dict(rows["limits"])
    for stage in ("early", "late"):
        results[f"{stage}_step_ms"] = rows[stage]["step_ms"]
        for name, row in rows[stage]["ops"].items():
            results[f"{stage}_{slug(name)}_ms"] = row["ms"]
            results[f"{stage}_{slug(name)}_of_limit"] = row["limit_ms"] / row["ms"]
    return results


def markdown(rows: dict[str, Row], made: Row) -> str:
    """The page."""
    limits = rows["limits"]
    columns = {
        "operation": "{name}",
        "ms": "{ms:.2f}",
        "MB": "{mb:.1f}",
        "GB/s": lambda r: f"{r['mb'] / r['ms']:.1f}",
        "of the copy": lambda r: f"{100 * r['mb'] / r['ms'] / limits['copy_gb_per_s']:.0f} %",
        "GFLOP/s": lambda r: f"{r['mflop'] / r['ms']:.0f}" if r["mflop"] else "",
        "limit, ms": "{limit_ms:.2f}",
        "of the limit": lambda r: f"{100 * r['limit_ms'] / r['ms']:.0f} %",
    }
    intro = f"""\
A copy moves {limits["copy_gb_per_s"]:.1f} GB/s (read and written), a product of matrices makes
{limits["matmul_gflop_per_s"]:.0f} GFLOP/s. The limit of an operation is the time of its bytes (every number that it
reads or writes once) at the one rate or of its sums at the other, whichever is longer. Rows are read by the cache line,
so no lookup can reach it."""
    blocks = []
    for stage in ("early", "late"):
        c = rows[stage]["counts"]
        blocks += [f"## {title(stage)} in training"]
        blocks += [
            f"{c['rays']} rays ({c['pixels']} of pixels), {c['intersected'] / c['rays']:.0f} intersected samples a ray "
            f"of which {c['kept'] / c['rays']:.0f} are kept, {c['rows'] / 1e3:.0f} thousand distinct rows. A step took "
            f"{rows[stage]['step_ms']:.0f} ms."
        ]
        blocks += [table(columns, ({"name": name, **r} for name, r in rows[stage]["ops"].items()))]
    return page("Operations of a training step against their limits", made, intro, blocks, "![Operations](ops.png)")


def draw(path: Path, rows: dict[str, Row]) -> None:
    """Milliseconds of every operation, and its limit."""
    with figure(path, 1, 2, (12, 4.5), sharey=True) as (axes,):
        for axis, stage in zip(axes, ("early", "late"), strict=True):
            ops = rows[stage]["ops"]
            axis.barh(list(ops), [r["ms"] for r in ops.values()], color="C0", alpha=0.6, label="measured")
            axis.plot([r["limit_ms"] for r in ops.values()], range(len(ops)), "k|", ms=12, label="limit")
            axis.set(xscale="log", xlabel="milliseconds", title=f"{stage}: {rows[stage]['step_ms']:.0f} ms a step")
        axes[0].invert_yaxis()


if __name__ == "__main__":
    sys.exit(run("ops", Ops))
