"""Training and rendering of ours, of a dense evaluation of the same planes, and of nerfacto."""

from __future__ import annotations

import statistics
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from all_planes import DenseSteps
from apart import Tell, run_apart
from lab import SceneBench, end_helpers, figure
from methods import METHODS, Method
from peers import leave_lpips_out
from report import Report, Row, page, table
from trainings import Request, train_apart

from mmpi_ns.bench.trainers import P, Steps
from mmpi_ns.scripts.command import run

KEEP_ALL = ("--pipeline.model.sampling.threshold", "0", "--pipeline.model.rendering.threshold", "0")
"""Every live sample is coloured and learns, as in a dense evaluation, with the same losses."""
NERFACTO_RAYS = 2048
"""Rays of a test image that nerfacto renders in each round."""


@dataclass
class Speed(SceneBench):
    """Training rays/s, frames and memory on a CPU, alternating in one process; what leaving samples out costs in dB.

    The dense reference evaluates every plane of every MPI for every ray, sorts all samples and colours those whose
    alpha exceeds 1e-4, with the photometric loss alone and plain Adam (on the same batches and at all texels). Its
    PSNR is that of our training when it keeps every sample, with the same losses and steps.
    """

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

    name = "speed"

    def run(self) -> None:
        report = Report(self, self.key())
        place = (P + "arrangement", self.arrangement, P + "planes", str(self.planes))
        ours = replace(METHODS["mmpi-small"], options=(*place, P + "max-planes", str(self.planes)))
        all_kept = replace(ours, options=(*ours.options, *KEEP_ALL))
        report.row("ours", lambda: self._train(ours, "ours"))
        report.row("keep all", lambda: self._train(all_kept, "keep-all"))
        report.row("rounds", lambda: self._rounds(ours))
        head = headline(report.rows)
        text = markdown(report.rows, head, report.content["made"])
        report.finish(head, text, lambda path: draw(path, report.rows["rounds"]))
        print(report.content["headline"])

    def _train(self, method: Method, folder: str) -> Row:
        print(f"{folder} ...", flush=True)
        looks: Row = {"check_images": self.test_images, "final_images": self.test_images}
        request = Request.of(method, self.scene, self.folder / folder, self.steps, self.rays, 0, **looks)
        return train_apart(request, self.cores)

    def _rounds(self, ours: Method) -> Row:
        print("rounds ...", flush=True)
        folder = self.folder / "rounds"
        names = ("steps", "dense_steps", "nerfacto_steps", "rounds", "full_size")
        request: dict[str, Any] = {name: getattr(self, name) for name in names}
        for name, method in (("ours", ours), ("nerfacto", METHODS["nerfacto"])):
            request[name] = method.words(self.scene, folder, self.steps, self.rays, 0, "cpu")
        return run_apart(take_turns, request, folder, self.cores)


def take_turns(request: dict[str, Any], tell: Tell) -> Row:
    """Rounds of everything in turn, in one process.

    Args:
        request: words for ns-train of ours and nerfacto, and the command's steps, rounds and full_size.
        tell: of progress.

    Returns:
        Rays/s of each round for ours, dense and nerfacto; after training, seconds of a frame and of a large one and
        rays/s of nerfacto's rendering; pixels of the frames; samples a ray of the dense reference.
    """
    leave_lpips_out()
    ours = Steps(request["ours"])
    dense, nerfacto = DenseSteps(ours), Steps(request["nerfacto"])
    batch, theirs = (each.pipeline.datamanager.get_train_rays_per_batch() for each in (ours, nerfacto))
    assert theirs == batch
    nerfacto.run(2)  # its process that prepares batches takes seconds to start
    dense.run(1)
    rounds, found, pixels = range(request["rounds"]), {}, {}
    steps = request["steps"] // len(rounds)
    peers = (("dense", dense, request["dense_steps"]), ("nerfacto", nerfacto, request["nerfacto_steps"]))

    def add(**more: float) -> None:
        for name, value in more.items():
            found.setdefault(name, []).append(value)
        tell(", ".join(f"{n} {v:.3g}" for n, v in more.items()))

    for _ in rounds:
        add(rays_per_s=steps * batch / ours.run(steps))
        add(**{f"{name}_rays_per_s": count * batch / peer.run(count) for name, peer, count in peers})
    for _ in rounds:  # frames of the trained model
        frame_s, pixels["frame_pixels"] = ours.render()
        full_s, pixels["frame_full_pixels"] = ours.render(request["full_size"])
        render_s, rays = nerfacto.render(rays=NERFACTO_RAYS)
        add(frame_s=frame_s, frame_full_s=full_s, nerfacto_render_rays_per_s=rays / render_s)
    end_helpers(nerfacto.trainer)
    whole_run = statistics.harmonic_mean(found["rays_per_s"])
    return {**found, **pixels, "whole_run_rays_per_s": whole_run, "dense_samples": dense.samples}


def headline(rows: dict[str, Row]) -> dict[str, float]:
    """Medians over the rounds, their ratios, and what leaving samples out costs."""
    rounds = rows["rounds"]
    found = {k: statistics.median(v) for k, v in rounds.items() if isinstance(v, list)}
    # Neighbours in time are compared: the machine's speed comes and goes.
    for peer in ("dense", "nerfacto"):
        pairs = zip(rounds["rays_per_s"], rounds[f"{peer}_rays_per_s"], strict=True)
        found[f"times_{peer}"] = statistics.median(a / b for a, b in pairs)
    return found | {
        "whole_run_rays_per_s": rounds["whole_run_rays_per_s"],
        "psnr_db": rows["ours"]["psnr"],
        "dense_psnr_db": rows["keep all"]["psnr"],
        "psnr_delta_db": rows["ours"]["psnr"] - rows["keep all"]["psnr"],
        "peak_memory_gib": rows["ours"]["peak_gib"],
        "keep_all_peak_memory_gib": rows["keep all"]["peak_gib"],
    }


def markdown(rows: dict[str, Row], h: dict[str, float], made: Row) -> str:
    """The page."""
    rounds, ours = rows["rounds"], rows["ours"]

    def spread(name: str) -> str:
        middle, least, most = (_digits(x) for x in (h[name], min(rounds[name]), max(rounds[name])))
        return f"{middle} ({least} to {most})"

    small, large, steps = rounds["frame_pixels"], rounds["frame_full_pixels"], ours["curve"][-1]["step"]
    lines = [
        ("training, rays/s", *(spread(p + "rays_per_s") for p in ("", "dense_", "nerfacto_"))),
        ("ours is faster by", "", f"{h['times_dense']:.1f}", f"{h['times_nerfacto']:.1f}"),
        ("rendering, rays/s", f"{small / h['frame_s']:.0f}", "", spread("nerfacto_render_rays_per_s")),
        (f"a frame of {small} pixels, s", spread("frame_s"), "", ""),
        (f"a frame of {large} pixels, s", spread("frame_full_s"), "", ""),
        (f"PSNR after {steps} steps, {ours['images']} test images", f"{h['psnr_db']:.3f}", f"{h['dense_psnr_db']:.3f}",
         ""),
        ("peak memory, GiB", f"{h['peak_memory_gib']:.2f}", "", ""),
    ]  # fmt: skip
    columns = {name: f"{{cells[{i}]}}" for i, name in enumerate(("", "ours", "dense", "nerfacto"))}
    said = f"""\
Medians of {len(rounds["rays_per_s"])} rounds in one process (least to most in brackets), in which each has its turn of
training; frames are rendered in turn after that. Rays are pixel rays (ours trains on 384 keypoint rays a step
besides, where there are SfM tracks). The dense reference evaluates all planes of all MPIs and has the photometric
loss alone."""
    whole = f"""\
Ours over the whole run, growth included: {h["whole_run_rays_per_s"]:.0f} rays/s. The PSNR under dense is that of our
training with every sample kept ({h["keep_all_peak_memory_gib"]:.2f} GiB): leaving samples out costs
{-h["psnr_delta_db"]:.3f} dB."""
    return page("Speed", made, said, table(columns, ({"cells": x} for x in lines)), whole, "![Rays/s](speed.png)")


def _digits(x: float) -> str:
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"


def draw(path: Path, rounds: Row) -> None:
    """Training rays/s of every round, on a logarithmic axis."""
    with figure(path, 1, 1, (6, 3.5)) as ((axis,),):
        for i, prefix in enumerate(("", "dense_", "nerfacto_")):
            rates = rounds[prefix + "rays_per_s"]
            middle = statistics.median(rates)
            axis.bar(i, middle, color=f"C{i}", alpha=0.5)
            axis.plot([i] * len(rates), rates, "k.", ms=4)
            axis.text(i, middle, f"{middle:.0f}", ha="center", va="bottom")
        axis.set_xticks(range(3), ["ours", "dense", "nerfacto"])
        axis.set(yscale="log", ylabel="training rays/s")


if __name__ == "__main__":
    sys.exit(run("speed", Speed))
