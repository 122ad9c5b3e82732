"""``mmpi-bench speed``: training and rendering of ours, of a dense evaluation of the same planes, and of nerfacto."""

from __future__ import annotations

import math
import os
import statistics
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from mmpi_ns.bench.apart import run_apart
from mmpi_ns.bench.methods import METHODS, Method, Scene
from mmpi_ns.bench.provenance import fingerprint, read_json, stamp, stamp_line, write_json
from mmpi_ns.bench.quality.train import train_apart
from mmpi_ns.bench.speed.alternate import Request as Rounds
from mmpi_ns.bench.suites import P
from mmpi_ns.bench.trainings import Request

KEEP_ALL = ("--pipeline.model.train-threshold", "0", "--pipeline.model.render-threshold", "0")
"""Every live sample is coloured and learns, as in a dense evaluation, with the same losses."""


@dataclass
class Speed:
    """Training rays/s, frames and memory on a CPU, alternating in one process; what leaving samples out costs in dB.

    The dense reference evaluates every plane of every MPI for every ray, sorts all samples and colours those whose
    alpha exceeds 1e-4, with the photometric loss alone and plain Adam (frozen code, on the same batches and at all
    texels). Its PSNR is that of our training when it keeps every sample, with the same losses and steps.
    """

    data: Path
    """The scene (a folder with transforms.json)."""
    downscale_factor: int = 4
    """Image size to use."""
    arrangement: Literal["drive", "automatic"] = "drive"
    """Four hand-made MPIs for a drive, or what placement finds."""
    planes: int = 64
    """Planes of every MPI (drive), or at most (automatic)."""
    steps: int = 600
    """Training steps of ours in all; the rounds share them."""
    rounds: int = 5
    """Turns of each; medians count."""
    dense_steps: int = 3
    """Steps of the dense reference in a round."""
    nerfacto_steps: int = 5
    """Steps of nerfacto in a round."""
    rays: int = 1024
    """Pixel rays of a step, for all."""
    full_size: int = 4
    """A full frame has so many times the width and height."""
    test_images: int = 8
    """Test images, evenly spaced, for PSNR; 0 for all."""
    threads: int = 0
    """0 for all cores."""
    output: Path = Path("docs/results")
    """Where speed.json, speed.md and speed.png go."""
    work: Path = Path("outputs/speed")
    """Where runs and their logs go."""

    def run(self) -> None:
        made, path = stamp("speed", self), self.output / "speed.json"
        threads = made["threads"] = self.threads or os.cpu_count() or 1
        key = f"{fingerprint()} {self._key()}"
        before = read_json(path)
        rows = before.get("rows", {}) if before.get("key") == key else {}
        content: dict[str, Any] = {"headline": {}, "made": made, "key": key, "rows": rows}
        place = (
            P + "arrangement",
            self.arrangement,
            P + "planes",
            str(self.planes),
            P + "max-planes",
            str(self.planes),
        )
        ours = replace(METHODS["mmpi-small"], options=place)
        parts = {
            "ours": lambda folder: self._train(ours, folder, threads),
            "keep all": lambda folder: self._train(replace(ours, options=(*place, *KEEP_ALL)), folder, threads),
            "rounds": lambda folder: self._rounds(ours, folder, threads),
        }
        for name, part in parts.items():
            print(f"{name} ...", flush=True)
            if name not in rows:
                row = part(self.work / name.replace(" ", "-"))
                if "not_run" in row:
                    raise ValueError(f"{name}: {row['not_run']}")
                rows[name] = row
                write_json(path, content)
        content["headline"] = headline(rows)
        write_json(path, content)
        (self.output / "speed.md").write_text(table(content), encoding="utf-8")
        draw(self.output / "speed.png", content)
        print(content["headline"])

    def _key(self) -> dict[str, str]:
        """What a result depends on."""
        own = {k: str(v) for k, v in asdict(self).items() if k not in ("output", "work")}
        return own | {"data": self.data.resolve().name}

    def _words(self, method: Method, folder: Path) -> list[str]:
        scene = Scene(self.data, self.downscale_factor)
        return method.words(scene, folder, self.steps, self.rays, 0, "cpu")

    def _train(self, method: Method, folder: Path, threads: int) -> dict[str, Any]:
        request = Request(
            words=tuple(self._words(method, folder)),
            data=str(self.data),
            downscale_factor=self.downscale_factor,
            work=str(folder),
            checks=(self.steps,),
            check_images=self.test_images,
            check_pixels=64,
            final_images=self.test_images,
            whole_images=False,
            keep=False,
        )
        return train_apart(request, folder, threads)

    def _rounds(self, ours: Method, folder: Path, threads: int) -> dict[str, Any]:
        request = Rounds(
            ours=self._words(ours, folder),
            nerfacto=self._words(METHODS["nerfacto"], folder),
            steps=self.steps,
            dense_steps=self.dense_steps,
            nerfacto_steps=self.nerfacto_steps,
            rounds=self.rounds,
            full_size=self.full_size,
            nerfacto_rays=2048,
        )
        return run_apart("mmpi_ns.bench.speed.alternate", asdict(request), folder, threads)


def headline(rows: dict[str, Any]) -> dict[str, float]:
    """Medians over the rounds, their ratios, and what leaving samples out costs."""
    rounds = rows["rounds"]
    found = {k: statistics.median(v) for k, v in rounds.items() if isinstance(v, list)}
    # Neighbours in time are compared: the machine's speed comes and goes.
    for peer in ("dense", "nerfacto"):
        pairs = zip(rounds["rays_per_s"], rounds[f"{peer}_rays_per_s"], strict=True)
        found[f"times_{peer}"] = statistics.median(a / b for a, b in pairs)
    found |= {
        "whole_run_rays_per_s": rounds["whole_run_rays_per_s"],
        "psnr_db": rows["ours"]["psnr"],
        "dense_psnr_db": rows["keep all"]["psnr"],
        "psnr_delta_db": rows["ours"]["psnr"] - rows["keep all"]["psnr"],
        "peak_memory_gib": rows["ours"]["peak_gib"],
        "keep_all_peak_memory_gib": rows["keep all"]["peak_gib"],
    }
    return {k: v for k, v in found.items() if math.isfinite(v)}


def table(content: dict[str, Any]) -> str:
    """The Markdown page."""
    h, rows = content["headline"], content["rows"]
    rounds = rows["rounds"]

    def spread(name: str) -> str:
        middle, least, most = (_digits(x) for x in (h[name], min(rounds[name]), max(rounds[name])))
        return f"{middle} ({least} to {most})"

    images = f"{rows['ours']['images']} test images"
    lines = [
        "# Speed",
        "",
        stamp_line(content["made"]),
        "",
        f"Medians of {len(rounds['rays_per_s'])} rounds in one process (least to most in brackets), in which each has",
        "its turn of training; frames are rendered in turn after that. Rays are pixel rays (ours trains on 384",
        "keypoint rays a step besides, where there are SfM tracks). The dense reference evaluates all planes of all",
        "MPIs and has the photometric loss alone.",
        "",
        "| | ours | dense | nerfacto |",
        "|---|---|---|---|",
        f"| training, rays/s | {' | '.join(spread(p + 'rays_per_s') for p in ('', 'dense_', 'nerfacto_'))} |",
        f"| ours is faster by | | {h['times_dense']:.1f} | {h['times_nerfacto']:.1f} |",
        f"| rendering, rays/s | {rounds['frame_pixels'] / h['frame_s']:.0f} | "
        f"| {spread('nerfacto_render_rays_per_s')} |",
        f"| a frame of {rounds['frame_pixels']} pixels, s | {spread('frame_s')} | | |",
        f"| a frame of {rounds['frame_full_pixels']} pixels, s | {spread('frame_full_s')} | | |",
        f"| PSNR after {rows['ours']['curve'][-1]['step']} steps, {images} | {h['psnr_db']:.3f} "
        f"| {h['dense_psnr_db']:.3f} | |",
        f"| peak memory, GiB | {h['peak_memory_gib']:.2f} | | |",
        "",
        f"Ours over the whole run, growth included: {h['whole_run_rays_per_s']:.0f} rays/s. The PSNR under dense is",
        f"that of our training with every sample kept ({h['keep_all_peak_memory_gib']:.2f} GiB): leaving samples out",
        f"costs {-h['psnr_delta_db']:.3f} dB.",
        "",
        "![Rays per second](speed.png)",
        "",
    ]
    return "\n".join(lines)


def _digits(x: float) -> str:
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"


def draw(path: Path, content: dict[str, Any]) -> None:
    """Training rays/s of every round, on a logarithmic axis."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rounds = content["rows"]["rounds"]
    names = {"ours": "rays_per_s", "dense": "dense_rays_per_s", "nerfacto": "nerfacto_rays_per_s"}
    figure, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
    for i, name in enumerate(names.values()):
        middle = statistics.median(rounds[name])
        axis.bar(i, middle, color=f"C{i}", alpha=0.5)
        axis.plot([i] * len(rounds[name]), rounds[name], "k.", ms=4)
        axis.text(i, middle, f"{middle:.0f}", ha="center", va="bottom")
    axis.set_xticks(range(len(names)), list(names))
    axis.set(yscale="log", ylabel="training rays/s")
    axis.grid(alpha=0.3, axis="y")
    figure.savefig(path, dpi=110)
    plt.close(figure)
