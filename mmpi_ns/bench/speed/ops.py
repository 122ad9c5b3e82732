"""``mmpi-bench ops``: each operation of a step against the bytes and sums that it cannot do without."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mmpi_ns.bench.methods import METHODS, Scene
from mmpi_ns.bench.provenance import fingerprint, read_json, stamp, stamp_line, write_json
from mmpi_ns.bench.speed.alternate import Steps, clock
from mmpi_ns.field.samples import Gathered, Lookup, Taps, metadata_of
from mmpi_ns.model import MMPIModel
from mmpi_ns.ops.colors import colors
from mmpi_ns.ops.compositing import composite_weights, render_colors
from mmpi_ns.ops.interpolate import gather_rows, index_rows, interpolate_gathered, sum_by_position
from mmpi_ns.ops.merge import merge
from mmpi_ns.rendering.rendered import bounded

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
class Ops:
    """Milliseconds of each operation of a training step, beside what bandwidth and arithmetic would allow.

    The limit of an operation is its bytes (each number that it reads or writes counts once, however often it is looked
    up) over the bandwidth of a copy, or its sums over the rate of a matrix product, whichever takes longer.
    """

    data: Path
    """The scene (a folder with transforms.json)."""
    downscale_factor: int = 4
    """Image size to use."""
    early: int = 40
    """Steps before the first measurement, while resolution grows."""
    steps: int = 600
    """Steps of the whole training; measured again after the last."""
    rays: int = 1024
    """Pixel rays of a step."""
    repeats: int = 5
    """Times that each operation runs; the median counts."""
    threads: int = 0
    """0 for all cores."""
    output: Path = Path("docs/results")
    """Where ops.json, ops.md and ops.png go."""
    work: Path = Path("outputs/ops")
    """Where the run goes."""

    def run(self) -> None:
        if not 0 < self.early < self.steps:
            raise ValueError(f"--early {self.early}: give a number between 0 and --steps ({self.steps}).")
        if self.threads:
            torch.set_num_threads(self.threads)
        made, path = stamp("ops", self), self.output / "ops.json"
        key = f"{fingerprint()} {made['command']} {made['threads']}"
        content = read_json(path)
        if content.get("key") != key:
            content = {"headline": {}, "made": made, "key": key, **self._measure()}
            content["headline"] = headline(content)
            write_json(path, content)
        (self.output / "ops.md").write_text(table(content), encoding="utf-8")
        draw(self.output / "ops.png", content)
        print(content["headline"])

    def _measure(self) -> dict[str, Any]:
        device = "cuda" if torch.cuda.is_available() else "cpu"
        scene = Scene(self.data, self.downscale_factor)
        steps = Steps(METHODS["mmpi-small"].words(scene, self.work, self.steps, self.rays, 0, device))
        limits = {"copy_gb_per_s": copy_rate(device) / 1e9, "matmul_gflop_per_s": matmul_rate(device) / 1e9}
        print(limits, flush=True)
        stages = {}
        for name, until in (("early", self.early), ("late", self.steps)):
            step_s = steps.run(until - steps.step) / (until - (0 if name == "early" else self.early))
            stages[name] = {**measure(steps, self.repeats), "step_ms": 1e3 * step_s}
        return {"limits": limits, "stages": stages}


def copy_rate(device: str) -> float:
    """Bytes a second, read and written."""
    a = torch.ones(COPIED, device=device)
    b = torch.empty_like(a)
    return 8 * COPIED / _seconds(lambda: b.copy_(a), 5)


def matmul_rate(device: str) -> float:
    """Multiplications and additions a second of a large product in float32."""
    a = torch.rand(2048, 2048, device=device)
    return 2 * 2048**3 / _seconds(lambda: a @ a, 5)


def _seconds(work: Callable[[], Any], repeats: int) -> float:
    """Median, after one untimed call."""
    work()
    times = []
    for _ in range(repeats):
        start = clock()
        work()
        times.append(clock() - start)
    return statistics.median(times)


def measure(steps: Steps, repeats: int) -> dict[str, Any]:
    """All operations on the batch of the next step."""
    model = steps.pipeline.model
    assert isinstance(model, MMPIModel)
    model.train()
    ops, counts = operations(model, steps)
    rows = {}
    for op in ops:
        assert op.name not in rows, f"two operations are called {op.name}"
        seconds = _seconds(op.work, repeats)
        rows[op.name] = {"ms": 1e3 * seconds, "mb": op.bytes_ / 1e6, "mflop": op.flops / 1e6}
        print(f"{op.name}: {1e3 * seconds:.2f} ms", flush=True)
    return {"ops": rows, "counts": counts}


def operations(model: MMPIModel, steps: Steps) -> tuple[list[Op], dict[str, float]]:
    """The operations of a training step on one batch, and how much there is of everything."""
    bundle, batch = steps.pipeline.datamanager.next_train(steps.step)
    field = model.field
    bundle = bounded(bundle, field.plan)

    def sample():
        return model.sampler(bundle, field=field, **model.training_bounds())

    samples, report = sample()
    lookup = field._lookup(samples)
    assert lookup.gathered is not None
    meta = metadata_of(samples)
    (num_rays, slots), live, kept = lookup.shape, float(report.live.sum()), float(len(lookup.index))
    channels, rows, taps = field.feature_channels, float(len(lookup.gathered.rows)), lookup.groups[0]
    counts = {"rays": num_rays, "live": live, "kept": kept, "rows": rows, "pixels": len(batch["image"])}
    kept_bytes = 2 * 4 + 3 * 4 + 3 * 4 + 1  # head and plane, position, distance and depths, whether valid
    ops = [
        Op("march: look up, merge, keep", sample, live * 4 * 4 + kept * kept_bytes),
        _sort(report.live, slots),
        Op("index of rows", lambda: index_rows(taps.rows), taps.rows.numel() * (8 + 4) + rows * 8),
    ]
    ops += _interpolation(field, taps, lookup.gathered, channels)
    ops += _colors(field, samples, lookup, channels)
    ops += _compositing(field, samples, meta, report)
    ops.append(_variation(field, lookup, rows * (1 + channels) * 2 * 4))
    ops.append(_adam(model, steps, rows * (1 + channels) * 7 * 4))
    return ops, counts


def _sort(live: Tensor, slots: int) -> Op:
    """Merging by one stable sort, as the plain path does (the compiled march merges as it goes)."""
    count, width = int(live.sum()), int(live.max())
    starts = live.cumsum(0) - live
    rays = torch.repeat_interleave(torch.arange(len(live), device=live.device), live)
    places = rays * width + torch.arange(count, device=live.device) - starts[rays]
    keys = torch.rand(count, generator=torch.Generator().manual_seed(slots)).to(live.device)
    return Op("merge by a sort", lambda: merge(places, keys, live, False), count * (8 + 4) + len(live) * width * 9)


def _interpolation(field: Any, taps: Taps, gathered: Gathered, channels: int) -> list[Op]:
    """Features of the kept samples from the distinct rows, and back."""
    position, weights, rows = taps.position, taps.weights, gathered.rows
    assert position is not None
    read, values = position.numel() * (position.element_size() + 4), len(position) * channels * 4
    table = len(rows) * channels * 4
    known = gathered.features.detach()
    grad = torch.rand(len(position), channels, device=weights.device)
    return [
        Op("gather rows", lambda: gather_rows(field.features.data, rows), len(rows) * 8 + 2 * table),
        Op("interpolation", lambda: interpolate_gathered(known, position, weights), read + table + values),
        Op(
            "interpolation, backward",
            lambda: sum_by_position(position, grad, weights, len(rows)),
            read + table + values,
        ),
    ]


def _colors(field: Any, samples: Any, lookup: Lookup, channels: int) -> list[Op]:
    """Colour networks on looked-up features, and back."""
    networks, (k, own) = field.networks, max(lookup.spans, key=lambda s: s[1].stop - s[1].start)
    ndc, rays = lookup.ndc[own], lookup.rays[own]
    features = torch.rand(len(ndc), channels, device=ndc.device).requires_grad_()
    directions = samples.frustums.directions[:, 0]
    weights = sum(math.prod(s) for s in networks.shapes[::2])
    moved, sums = len(ndc) * (channels + 3 + 3) * 4, 2.0 * weights * len(ndc)

    def forward() -> Tensor:
        return colors(networks, k, features, ndc, directions, rays)

    def both() -> None:
        forward().sum().backward()
        features.grad = networks.weights.grad = None

    return [
        Op("colour network of one MPI", forward, moved, sums),
        Op("colour network of one MPI, and backward", both, 2 * moved, 3 * sums),
    ]


def _compositing(field: Any, samples: Any, meta: dict[str, Tensor], report: Any) -> list[Op]:
    valid, skipped = meta["valid"][..., 0], meta["skipped_before"][..., 0]
    tau = meta["tau"][..., 0].clone().requires_grad_()
    colors = torch.rand(*valid.shape, 3, device=tau.device).requires_grad_()

    def forward() -> Tensor:
        return render_colors(composite_weights(tau, valid, skipped, report.skipped_total), colors)

    def both() -> None:
        forward().sum().backward()
        tau.grad = colors.grad = None

    moved = valid.numel() * (4 + 4 + 1 + 3 * 4)
    return [Op("compositing", forward, moved), Op("compositing, and backward", both, 2 * moved)]


def _variation(field: Any, lookup: Lookup, moved: float) -> Op:
    def work() -> None:
        field.total_variation(lookup, 1e-5, 1e-6).backward()
        field.density.grad = field.features.grad = None

    # The rows are gathered again each time: what a backward pass went through is gone.
    def fresh() -> None:
        nonlocal lookup
        assert lookup.gathered is not None
        rows = lookup.gathered.rows
        density, features = (gather_rows(t, rows) for t in (field.density, field.features))
        lookup = Lookup(**{**vars(lookup), "gathered": Gathered(rows, density, features)})
        work()

    return Op("total variation, forward and backward", fresh, moved)


def _adam(model: MMPIModel, steps: Steps, moved: float) -> Op:
    """The optimisers' step with the gradients of one batch; restores nothing: some more steps do no harm."""
    trainer = steps.trainer
    _, losses, _ = steps.pipeline.get_train_loss_dict(step=steps.step)
    for optimizer in trainer.optimizers.optimizers.values():
        optimizer.zero_grad()
    torch.stack([loss.reshape(()) for loss in losses.values()]).sum().backward()

    params = [p for o in trainer.optimizers.optimizers.values() for g in o.param_groups for p in g["params"]]
    grads = [p.grad for p in params]

    def work() -> None:
        for p, grad in zip(params, grads, strict=True):
            p.grad = grad
        for optimizer in trainer.optimizers.optimizers.values():
            optimizer.step()
        for p in params:
            p.grad = None  # other operations have gradients of their own

    return Op("Adam", work, moved)


def _limit(row: dict[str, float], limits: dict[str, float]) -> float:
    """Milliseconds that an operation takes at least."""
    return max(row["mb"] / limits["copy_gb_per_s"], row["mflop"] / limits["matmul_gflop_per_s"])


def headline(content: dict[str, Any]) -> dict[str, float]:
    """Rates of the machine, and of each operation its milliseconds and the share of its limit that it reaches."""
    found: dict[str, float] = dict(content["limits"])
    for stage, rows in content["stages"].items():
        found[f"{stage}_step_ms"] = rows["step_ms"]
        for name, row in rows["ops"].items():
            slug = "_".join("".join(c if c.isalnum() else " " for c in name.lower()).split())
            found[f"{stage}_{slug}_ms"] = row["ms"]
            found[f"{stage}_{slug}_of_limit"] = _limit(row, content["limits"]) / row["ms"]
    return found


def table(content: dict[str, Any]) -> str:
    """The Markdown page."""
    limits = content["limits"]
    lines = [
        "# Operations of a training step against their limits",
        "",
        stamp_line(content["made"]),
        "",
        f"A copy moves {limits['copy_gb_per_s']:.1f} GB/s (read and written), a product of matrices makes",
        f"{limits['matmul_gflop_per_s']:.0f} GFLOP/s. The limit of an operation is the time of its bytes (every",
        "number that it reads or writes once) at the one rate or of its sums at the other, whichever is longer. Rows",
        "are read by the cache line, so no lookup can reach it.",
    ]
    for stage, found in content["stages"].items():
        c = found["counts"]
        lines += [
            "",
            f"## {stage[0].upper()}{stage[1:]} in training",
            "",
            f"{c['rays']} rays ({c['pixels']} of pixels), {c['live'] / c['rays']:.0f} live samples a ray of which",
            f"{c['kept'] / c['rays']:.0f} are kept, {c['rows'] / 1e3:.0f} thousand distinct rows. A step took "
            f"{found['step_ms']:.0f} ms.",
            "",
            "| operation | ms | MB | GB/s | of the copy | GFLOP/s | limit, ms | of the limit |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for name, r in found["ops"].items():
            rate, limit = r["mb"] / r["ms"], _limit(r, limits)
            flops = f"{r['mflop'] / r['ms']:.0f}" if r["mflop"] else ""
            lines.append(
                f"| {name} | {r['ms']:.2f} | {r['mb']:.1f} | {rate:.1f} | {100 * rate / limits['copy_gb_per_s']:.0f} % "
                f"| {flops} | {limit:.2f} | {100 * limit / r['ms']:.0f} % |"
            )
    return "\n".join([*lines, "", "![Operations](ops.png)", ""])


def draw(path: Path, content: dict[str, Any]) -> None:
    """Milliseconds of every operation, and its limit."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    stages = content["stages"]
    figure, axes = plt.subplots(1, len(stages), figsize=(12, 4.5), layout="constrained", sharey=True)
    for axis, (stage, found) in zip(axes, stages.items(), strict=True):
        named = list(found["ops"].items())
        axis.barh([n for n, _ in named], [r["ms"] for _, r in named], color="C0", alpha=0.6, label="measured")
        axis.plot([_limit(r, content["limits"]) for _, r in named], range(len(named)), "k|", ms=12, label="limit")
        axis.set(xscale="log", xlabel="milliseconds", title=f"{stage}: {found['step_ms']:.0f} ms a step")
        axis.grid(alpha=0.3, axis="x")
    axes[0].invert_yaxis()
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
