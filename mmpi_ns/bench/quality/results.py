"""Trains and evaluates the variants of a suite with the real commands, and writes JSON and a Markdown table."""

from __future__ import annotations

import functools
import json
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from mmpi_ns.bench.provenance import commit, processor
from mmpi_ns.bench.suites import DEFAULT, SUITES, Variant
from mmpi_ns.capture.load import load_observations
from mmpi_ns.placement.errors import pixel_errors
from mmpi_ns.placement.observations import Observations
from mmpi_ns.placement.visibility import find_visible_points
from mmpi_ns.scene.plan import ScenePlan

RAYS_PER_STEP = 1024


@dataclass
class Results:
    """Trains and evaluates every variant of a suite on a scene, as a user would."""

    data: Path
    """The scene (a folder with transforms.json)."""
    suite: str
    """Which variants: kitti-street, room-walk, fern, fox; kitti-street-budgets and room-walk-budgets draw quality over
    texels."""
    downscale_factor: int = 4
    """Image size to use."""
    output: Path = Path("docs/results")
    """Where SUITE.json and SUITE.md go; finished rows in SUITE.json are not run again."""
    work: Path = Path("outputs/results")
    """Where runs and renders go."""
    parallel: int = 1
    """Runs at the same time, each with its share of the cores."""
    threads: int = 0
    """Threads of a run; 0 for all cores / parallel."""
    only: str = ""
    """Run only variants whose group and name contain this."""

    def run(self) -> None:
        path = self.output / f"{self.suite}.json"
        done: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        wanted = [v for v in SUITES[self.suite] if self.only in _key(v) and _key(v) not in done]
        self.output.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(self.parallel) as pool:
            for variant, row in zip(wanted, pool.map(self._row, wanted), strict=True):
                done[_key(variant)] = row
                path.write_text(json.dumps(done, indent=1), encoding="utf-8")
                print(json.dumps({_key(variant): row}), flush=True)
        (self.output / f"{self.suite}.md").write_text(self._table(done), encoding="utf-8")
        if self.suite.endswith("-budgets"):
            draw_budgets(self.output / f"{self.suite}.png", done)

    def _row(self, variant: Variant) -> dict[str, Any]:
        name = re.sub(r"[^a-z0-9]+", "-", _key(variant).lower()).strip("-")
        folder = self.work / self.suite / name
        threads = self.threads or max(1, (os.cpu_count() or 1) // self.parallel)
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
        steps = [] if variant.steps is None else ["--max-num-iterations", str(variant.steps)]
        scene = ["--data", str(self.data), "nerfstudio-data", "--downscale-factor", str(self.downscale_factor)]
        place = ["--output-dir", str(folder), "--experiment-name", "run", "--timestamp", "1"]
        start = time.perf_counter()
        _command(
            ["ns-train", variant.method, *place, "--vis", "tensorboard", *steps, *variant.options, *scene],
            folder,
            environment,
        )
        seconds = time.perf_counter() - start
        run = folder / "run" / variant.method / "1"
        render = ["--output-path", str(folder / "eval.json"), "--render-output-path", str(folder / "renders")]
        _command(["ns-eval", "--load-config", str(run / "config.yml"), *render], folder, environment)
        results = json.loads((folder / "eval.json").read_text(encoding="utf-8"))["results"]
        row = {k: results[k] for k in ("psnr", "ssim", "num_rays_per_sec", "dropped_mass") if k in results}
        row.update({k: v for k, v in results.items() if k.startswith("lpips") and not k.endswith("std")})
        row.update(self._plan_figures(run))
        row["train_seconds"] = seconds
        row["steps"] = _steps(run)
        row["threads"] = threads
        row["processor"] = processor()
        row["commit"] = commit()
        row["date"] = date.today().isoformat()
        row["command"] = " ".join(["ns-train", variant.method, *steps, *variant.options])
        return row

    def _plan_figures(self, run: Path) -> dict[str, Any]:
        """MPIs, texels and expected pixel errors of the plan that a run used."""
        plan = ScenePlan.load(run / "plan.json")
        observations = _observations(self.data, self.downscale_factor)
        visible = find_visible_points(observations)
        errors = pixel_errors(plan, observations, visible.cameras, visible.points).summary()
        return {"mpis": len(plan.mpis), "texels": plan.texels, **errors}

    def _table(self, rows: dict[str, Any]) -> str:
        command = f"python -m mmpi_ns.bench results --suite {self.suite} --downscale-factor {self.downscale_factor}"
        lines = [
            f"# {self.suite}, images at 1/{self.downscale_factor}",
            "",
            f"Made by `{command} --data <scene>` on {' and '.join(sorted({r['processor'] for r in rows.values()}))}.",
            "Every figure is `ns-eval`'s mean over all test images. Rays are pixel rays of training;",
            "e_p and e_t are the expected pixel errors for lack of planes and of texels",
            "(median / 90th percentile over the training observations, each in the MPI that serves it best).",
        ]
        for group in dict.fromkeys(v.group for v in SUITES[self.suite]):
            lines += ["", f"## {group}" if group else "", "", _HEADER, _HEADER_LINE]
            lines += [_line(v.name, rows[_key(v)]) for v in SUITES[self.suite] if v.group == group and _key(v) in rows]
        commits = sorted({f"{r['commit']} ({r['date']})" for r in rows.values()})
        return "\n".join([*lines, "", f"Commits: {', '.join(commits)}. Options of each row: `{self.suite}.json`.", ""])


_HEADER = (
    "| variant | PSNR | SSIM | LPIPS | rays | training, s | threads | render rays/s | MPIs | M texels | e_p | e_t |"
)
_HEADER_LINE = "|---|" + "---|" * 11


def _line(name: str, r: dict[str, Any]) -> str:
    lpips = next((f"{v:.3f}" for k, v in r.items() if k.startswith("lpips")), "no weights")
    cells = [
        name,
        f"{r['psnr']:.2f}",
        f"{r['ssim']:.3f}",
        lpips,
        f"{r['steps'] * RAYS_PER_STEP / 1e6:.2f} M",
        f"{r['train_seconds']:.0f}",
        str(r["threads"]),
        f"{r['num_rays_per_sec']:.0f}",
        str(r["mpis"]),
        f"{r['texels'] / 1e6:.1f}",
        f"{r['e_p_50']:.2f} / {r['e_p_90']:.2f}",
        f"{r['e_t_50']:.2f} / {r['e_t_90']:.2f}",
    ]
    return "| " + " | ".join(cells) + " |"


def draw_budgets(path: Path, rows: dict[str, Any]) -> None:
    """PSNR and SSIM over millions of texels, the default apart.

    Args:
        path: of the picture.
        rows: by name, with texels, psnr and ssim.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    held = sorted((r for name, r in rows.items() if name != DEFAULT), key=lambda r: r["texels"])
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    texels = [r["texels"] / 1e6 for r in held]
    ticks = [m for m in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if 0.7 * min(texels) <= m <= 1.4 * max(texels)]
    for axis, what, label in zip(axes, ("psnr", "ssim"), ("PSNR, dB", "SSIM"), strict=True):
        axis.plot(texels, [r[what] for r in held], "o-", color="0.4", label="held to a budget")
        if DEFAULT in rows:
            row = rows[DEFAULT]
            axis.plot(row["texels"] / 1e6, row[what], "*", markersize=13, color="tab:red", label=DEFAULT)
        axis.set(xscale="log", xlabel="million texels", ylabel=label)
        axis.set_xticks(ticks, [f"{m:g}" for m in ticks])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _key(variant: Variant) -> str:
    return f"{variant.group}: {variant.name}" if variant.group else variant.name


@functools.cache
def _observations(data: Path, downscale_factor: int) -> Observations:
    return load_observations(data, downscale_factor)


def _steps(run: Path) -> int:
    last = max(int(p.stem.split("-")[1]) for p in (run / "nerfstudio_models").glob("step-*.ckpt"))
    return last + 1


def _command(words: list[str], folder: Path, environment: dict[str, str]) -> None:
    """Runs a command of this Python's environment; its output goes to a log beside the run."""
    folder.mkdir(parents=True, exist_ok=True)
    program = str(Path(sys.executable).with_name(words[0]))
    log = folder / f"{words[0]}.log"
    with log.open("w", encoding="utf-8") as stream:
        code = subprocess.run(
            [program, *words[1:]], stdout=stream, stderr=subprocess.STDOUT, env=environment
        ).returncode
    if code:
        raise RuntimeError(f"{words[0]} failed with status {code}: see {log}.")
