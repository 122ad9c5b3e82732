"""Trains and evaluates the variants of a suite with the real commands, as a user types them."""

from __future__ import annotations

import functools
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lab import SceneBench, figure, train_and_evaluate
from methods import Method
from report import Report, Row, page, slug, table
from suites import DEFAULT, SUITES

from mmpi_ns.placement.errors import PixelErrors, pixel_errors
from mmpi_ns.placement.observations import find_visible_points
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.scripts.command import run
from mmpi_ns.scripts.plan import load_observations

RAYS_PER_STEP = 1024


@dataclass
class Results(SceneBench):
    """Trains and evaluates every variant of a suite on a scene, as a user would.

    Rows that are finished are kept in SUITE.json.
    """

    suite: str
    """Which variants: kitti-street, room-walk, fern, fox; kitti-street-budgets and room-walk-budgets draw quality over
    texels."""
    only: str = ""
    """Run only variants whose group and name contain this."""

    name = "results"

    def run(self) -> None:
        if self.suite not in SUITES:
            raise ValueError(f"There is no suite {self.suite!r}: choose from {', '.join(SUITES)}.")
        report = Report(self, file=self.suite)
        for variant in SUITES[self.suite]:
            if self.only in variant.key:
                row = report.row(variant.key, lambda variant=variant: self._row(variant))
                print(json.dumps({variant.key: row}), flush=True)
        draw = (lambda path: draw_budgets(path, report.rows)) if self.suite.endswith("-budgets") else None
        head = {f"{slug(name)}_{what}": r[what] for name, r in report.rows.items() for what in ("psnr", "ssim")}
        report.finish(head, markdown(self.suite, report.content), draw)

    def _row(self, variant: Method) -> Row:
        folder = self.folder / self.suite / slug(variant.key, "-")
        steps = [] if not variant.steps else ["--max-num-iterations", str(variant.steps)]
        options, renders = [*steps, *variant.options], ["--render-output-path", str(folder / "renders")]
        run, results, made = train_and_evaluate(self.scene, folder, variant.registered, options, renders, self.cores)
        row = {k: results[k] for k in ("psnr", "ssim", "num_rays_per_sec", "dropped_mass") if k in results}
        row |= {k: v for k, v in results.items() if k.startswith("lpips") and not k.endswith("std")}
        # MPIs, texels and expected pixel errors of the plan that the run used.
        plan, observations = (
            WindowedPlan.load(run / "plan.json").plans[0],
            _observations(self.data, self.downscale_factor),
        )
        visible = find_visible_points(observations)
        row |= {"mpis": len(plan.mpis), "texels": plan.texels}
        row |= error_figures(pixel_errors(plan, observations, visible.cameras, visible.points))
        return row | made | {"steps": steps_of(run), "command": " ".join(["ns-train", variant.registered, *options])}


def error_figures(errors: PixelErrors) -> dict[str, float]:
    """Medians and 90th percentiles over the observations, each in its best head; fraction outside all heads."""
    served, heads = np.isfinite(errors.combined.min(-1)), errors.combined.argmin(-1)
    figures = {"unserved": float(1 - served.mean()) if len(served) else 0.0}
    for name, values in (("e_p", errors.plane), ("e_t", errors.texel)):
        best = np.take_along_axis(values, heads[:, None], -1)[served, 0]
        for q in (50, 90):
            figures[f"{name}_{q}"] = float(np.percentile(best, q)) if len(best) else float("nan")
    return figures


def markdown(suite: str, content: Row) -> str:
    """The page."""
    columns = {
        "variant": "{name}",
        "PSNR": "{psnr:.2f}",
        "SSIM": "{ssim:.3f}",
        "LPIPS": lambda r: next((f"{v:.3f}" for k, v in r.items() if k.startswith("lpips")), "no weights"),
        "rays": lambda r: f"{r['steps'] * RAYS_PER_STEP / 1e6:.2f} M",
        "training, s": "{train_seconds:.0f}",
        "threads": "{threads}",
        "render rays/s": "{num_rays_per_sec:.0f}",
        "MPIs": "{mpis}",
        "M texels": lambda r: f"{r['texels'] / 1e6:.1f}",
        "e_p": "{e_p_50:.2f} / {e_p_90:.2f}",
        "e_t": "{e_t_50:.2f} / {e_t_90:.2f}",
    }
    rows, blocks = content["rows"], []
    for group in dict.fromkeys(v.group for v in SUITES[suite]):
        own = ({"name": v.name, **rows[v.key]} for v in SUITES[suite] if v.group == group and v.key in rows)
        blocks += [f"## {group}" if group else "", table(columns, own)]
    commits = sorted({f"{r['commit']} ({r['date']})" for r in rows.values()})
    said = f"""\
Rows ran on {" and ".join(sorted({r["processor"] for r in rows.values()}))}. Every figure is `ns-eval`'s mean over all
test images. Rays are pixel rays of training; e_p and e_t are the expected pixel errors for lack of planes and of
texels (median / 90th percentile over the training observations, each in the MPI that serves it best)."""
    last = f"Commits: {', '.join(commits)}. Options of each row: `{suite}.json`."
    return page(suite, content["made"], said, blocks, last)


def draw_budgets(path: Path, rows: dict[str, Row]) -> None:
    """PSNR and SSIM over millions of texels, the default apart."""
    held = sorted((r for name, r in rows.items() if name != DEFAULT), key=lambda r: r["texels"])
    texels = [r["texels"] / 1e6 for r in held]
    ticks = [m for m in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if 0.7 * min(texels) <= m <= 1.4 * max(texels)]
    with figure(path, 1, 2, (9, 3.2)) as (axes,):
        for axis, what, label in zip(axes, ("psnr", "ssim"), ("PSNR, dB", "SSIM"), strict=True):
            axis.plot(texels, [r[what] for r in held], "o-", color="0.4", label="held to a budget")
            if DEFAULT in rows:
                row = rows[DEFAULT]
                axis.plot(row["texels"] / 1e6, row[what], "*", markersize=13, color="tab:red", label=DEFAULT)
            axis.set(xscale="log", xlabel="million texels", ylabel=label)
            axis.set_xticks(ticks, [f"{m:g}" for m in ticks])
            axis.minorticks_off()


@functools.cache
def _observations(data: Path, downscale_factor: int):
    return load_observations(data, downscale_factor)[0]


def steps_of(run: Path) -> int:
    """Steps of a finished run, by its last checkpoint."""
    return 1 + max(int(p.stem.split("-")[1]) for p in (run / "nerfstudio_models").glob("step-*.ckpt"))


if __name__ == "__main__":
    sys.exit(run("results", Results))
