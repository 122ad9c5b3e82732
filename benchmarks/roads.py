"""What a road costs by its length. A step, a frame and memory should not know how long it is."""

from __future__ import annotations

import statistics
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from apart import Tell, run_apart
from lab import figure, median_s, peak_gib
from methods import Method
from PIL import Image
from report import Bench, Report, Row, page, table

from mmpi_ns.bench.trainers import Scene, config_of, trainer_of
from mmpi_ns.ops.march import MarchOptions
from mmpi_ns.placement.split import place_windows
from mmpi_ns.rendering.metrics import ImageMetrics
from mmpi_ns.rendering.rendered import bounded
from mmpi_ns.sampler import march, rays_of
from mmpi_ns.scene.windows import Window
from mmpi_ns.scripts.command import run
from mmpi_ns.scripts.plan import load_observations
from mmpi_scene import catalogue
from mmpi_scene.dataset import image_name, write_dataset
from mmpi_scene.scene import render

BYTES_A_TEXEL = 4 * (1 + 9 + 1) + 1
"""Density, features, reliability and the mark of having been trained."""
RAYS = 1024


@dataclass
class Roads(Bench):
    """Procedural roads of several lengths: planning time and disk; step, frame and memory in some of their windows."""

    lengths: tuple[float, ...] = (100.0, 1000.0, 10000.0)
    """Metres."""
    steps: int = 200
    """Training steps of a window."""
    windows: int = 5
    """Windows of a road that are trained, spread evenly over it; medians count."""
    threads: int = field(default=1, kw_only=True)
    """Of each process."""

    name = "roads"

    def run(self) -> None:
        report = Report(self, self.key("lengths"))
        for length in self.lengths:
            r = report.row(f"{length:g} m", lambda length=length: self._measure(length))
            said = "{windows} windows, plan {plan_s:.0f} s, step {step_ms:.0f} ms, frame {frame_ms:.0f} ms"
            print(f"{length:g} m: {said.format(**r)}, {r['peak_gib']:.2f} GiB", flush=True)
        rows = list(report.rows.values())
        head = headline(rows)
        report.finish(head, markdown(report.content), lambda path: draw(path, rows))
        print(head)

    def _measure(self, length: float) -> Row:
        """One road: planned, and then trained, in two processes."""
        folder, row = self.folder / f"{length:g} m", {"length": length}
        request = {"length": length, "steps": self.steps, "windows": self.windows, "folder": str(folder)}
        for work in (plan_road, train_windows):
            row |= run_apart(work, request, folder / work.__name__, self.threads)
            if "not_run" in row:
                break
        return row


def some_windows(count: int, wanted: int) -> list[int]:
    """Numbers of so many of the windows, spread evenly and away from the ends of the road."""
    return sorted({round((i + 1) / (wanted + 1) * (count - 1)) for i in range(wanted)})


def plan_road(request: dict[str, Any], tell: Tell) -> Row:
    """Makes the scene (the images of some windows alone) and its plan.

    Args:
        request: length, steps and windows of the command, and folder of the road.
        tell: of progress.

    Returns:
        Seconds of planning, windows, MPIs of all and of the largest, texels of all and of the largest, cameras.
    """
    folder, length = Path(request["folder"]), request["length"]
    data, scene = folder / "data", catalogue.make_scene("long-road", length=length)
    write_dataset(scene, data, max(4000, 4 * round(length)), images=False, overwrite=True)
    observations = load_observations(data, downscale_factor=1)[0]
    config = _config(folder, request["steps"]).pipeline.model.placement
    start = time.perf_counter()
    plan = place_windows(observations, config, request["steps"] * RAYS)
    seconds = time.perf_counter() - start
    (folder / "plan.json").write_text(plan.to_json(), encoding="utf-8")
    _write_images(scene, data, [plan.windows[w] for w in some_windows(len(plan), request["windows"])])
    mpis, texels = [len(p.mpis) for p in plan.plans], [p.texels for p in plan.plans]
    row = {"cameras": len(scene.cameras), "plan_s": seconds, "windows": len(plan), "mpis": sum(mpis)}
    return row | {"most_mpis": max(mpis), "texels": sum(texels), "most_texels": max(texels)}


def _write_images(scene: Any, data: Path, windows: list[Window]) -> None:
    """Renders what the cameras about some windows see: those that they train with and are looked at from."""
    # Reads no images, but knows the scene's frame.
    manager = _config(data.parent, 10).pipeline.datamanager.setup(device="cpu", test_mode="inference")
    outputs = manager.train_dataparser_outputs
    transform = outputs.dataparser_transform.double().numpy()
    centers = scene.cameras.camera_to_worlds[:, :, 3] @ transform[:, :3].T + transform[:, 3]
    middles = np.array([w.center for w in windows])
    gaps = np.linalg.norm(centers[:, None] * outputs.dataparser_scale - middles, axis=-1)
    near = (gaps < [1.01 * (w.radius + w.margin) for w in windows]).any(-1)
    (data / "images").mkdir(exist_ok=True)
    for i in np.nonzero(near)[0].tolist():
        colors, _ = render(scene, i)
        Image.fromarray((colors * 255).round().astype(np.uint8)).save(data / "images" / image_name(i))


def train_windows(request: dict[str, Any], tell: Tell) -> Row:
    """Trains some windows as a run over all of them would, and renders a frame in the middle of each.

    Args:
        request: as for ``plan_road``.
        tell: of progress.

    Returns:
        Medians over the windows (and lists of them): milliseconds of a step after growth and of a frame (medians in
        themselves), MPIs and texels, PSNR of the frame; and how much memory the process held at most (GiB).
    """
    folder, steps = Path(request["folder"]), request["steps"]
    trainer = trainer_of(_config(folder, steps, "--pipeline.model.plan-file", str(folder / "plan.json")))
    plans, times, rows = trainer._run.progress.windows.plans, [], []
    step_once = trainer.train_iteration

    def timed(step: int) -> Any:
        start = time.perf_counter()
        result = step_once(step)
        times.append(time.perf_counter() - start)
        return result

    trainer.train_iteration = timed
    for window in some_windows(len(plans), request["windows"]):
        times.clear()
        trainer.train_window(window) if len(plans) > 1 else trainer.train()
        row = {"step_ms": 1e3 * statistics.median(times[steps // 2 :]), **_look(trainer, window)}
        rows.append(row | {"window_mpis": len(plans[window].mpis), "window_texels": plans[window].texels})
    found: Row = {name: statistics.median(r[name] for r in rows) for name in rows[0]}
    return found | {"by_window": rows, "peak_gib": peak_gib()}


@torch.no_grad()
def _look(trainer: Any, window: int) -> dict[str, float]:
    """The test view nearest to a window's middle: milliseconds of the frame (median of three), PSNR, and what its cost
    follows: samples that a ray meets, and those of them that are coloured."""
    model, data_set = trainer.pipeline.model.eval(), trainer.pipeline.datamanager.eval_dataset
    middle = torch.tensor(model.progress.windows.windows[window].center, dtype=torch.float64)
    nearest = int((data_set.cameras.camera_to_worlds[:, :, 3].double() - middle).norm(dim=-1).argmin())
    camera = data_set.cameras[nearest : nearest + 1]
    frame_ms = 1e3 * median_s(lambda: model.get_outputs_for_camera(camera), 3)
    rgb, truth = model.get_outputs_for_camera(camera)["rgb"], data_set.get_data(nearest)["image"][..., :3]
    rays = camera.generate_rays(0, keep_shape=False)
    some = bounded(rays[:: max(1, len(rays) // 4096)], model.field.plan)
    field, options = model.field, MarchOptions(model.config.rendering.threshold)
    samples = march(field.layout, field.tables, rays_of(some), options)
    kept, live = float(samples.valid.sum() / len(some)), float(samples.live.float().mean())
    psnr = ImageMetrics("none")(rgb, truth)["psnr"]
    return {"frame_ms": frame_ms, "psnr_db": psnr, "live_samples": live, "kept_samples": kept}


def _config(folder: Path, steps: int, *options: str) -> Any:
    """Of ``mmpi-small`` on the road in a folder, which holds no image in memory."""
    method = Method("road", "mmpi-small", ("--pipeline.datamanager.resident-pixels", "0", *options))
    return config_of(method.words(Scene(folder / "data", 1), folder / "run", steps, None, 0, "cpu"))


def headline(rows: list[Row]) -> dict[str, float]:
    """Longest over shortest: what should stay is near 1, what should grow is near the ratio of lengths."""
    first, last = min(rows, key=lambda r: r["length"]), max(rows, key=lambda r: r["length"])
    names = ("length", "step_ms", "frame_ms", "peak_gib", "plan_s", "texels", "windows")
    return {f"{name}_ratio": last[name] / first[name] for name in names}


def markdown(content: Row) -> str:
    """The page."""
    columns = {
        "road": "{name}",
        "cameras": "{cameras}",
        "windows": "{windows}",
        "MPIs in all": "{mpis}",
        "plan, s": "{plan_s:.0f}",
        "disk, GB": lambda r: f"{r['texels'] * BYTES_A_TEXEL / 1e9:.2f}",
        "MPIs of a window": "{window_mpis:g}",
        "step, ms": "{step_ms:.0f}",
        "frame, ms": "{frame_ms:.0f}",
        "samples a ray, coloured": "{live_samples:.0f}, {kept_samples:.0f}",
        "PSNR": "{psnr_db:.1f}",
        "memory, GiB": "{peak_gib:.2f}",
    }
    said = """\
Procedural bending roads (`mmpi-scene long-road`), an image of 320 x 96 pixels every 1.5 m. The whole road is
planned; some windows, spread evenly over it, are trained as a run through all would train them, and a frame
is rendered in the middle of each: medians. Disk is what all windows take when they are finished."""
    rows = ({"name": name, **r} for name, r in content["rows"].items())
    return page("Roads", content["made"], said, "![By length](roads.png)", table(columns, rows))


def draw(path: Path, rows: list[Row]) -> None:
    """What should stay, and what should grow, over the length."""
    lengths = [r["length"] for r in rows]
    with figure(path, 1, 2, (11, 4)) as ((stay, grow),):
        for axis, names in (
            (stay, {"step_ms": "step", "frame_ms": "frame", "peak_gib": "memory"}),
            (grow, {"plan_s": "planning time", "texels": "disk", "windows": "windows"}),
        ):
            for name, label in names.items():
                axis.plot(lengths, [r[name] / rows[0][name] for r in rows], "o-", label=label)
        grow.plot(lengths, [x / lengths[0] for x in lengths], color="0.7", label="linear")
        stay.axhspan(0.8, 1.2, color="0.9")
        stay.set(xscale="log", ylim=(0, None), xlabel="metres", ylabel="relative to the shortest")
        grow.set(xscale="log", yscale="log", xlabel="metres")


if __name__ == "__main__":
    sys.exit(run("roads", Roads))
