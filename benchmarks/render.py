"""Speed of rendering against its error, over the settings of rendering of a trained run."""

from __future__ import annotations

import copy
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np
import torch
from lab import figure
from plane_crossings import Image, images_of
from random_scenes import Array, in_float64
from random_scenes import render as render_plainly
from report import Bench, Report, Row, fingerprint, page, table

from mmpi_ns.model import MMPIModel
from mmpi_ns.ops import dispatch
from mmpi_ns.rendering.metrics import ImageMetrics
from mmpi_ns.rendering.rendered import BACKGROUNDS, bounded
from mmpi_ns.scripts.command import run
from mmpi_show.bake import load_model

EXACT_RAYS = 256
"""Rays that are rendered exactly at once."""
NOISE = 1.05
"""A setting must be so much faster than another to count as faster."""
SAME_DB = 5e-4
"""Losses of PSNR closer than this count as equal."""


@dataclass(frozen=True)
class Setting:
    """One way to render."""

    threshold: float
    chunk: int
    ops: str
    also: str = ""
    """group.name=value of a further setting of the model."""

    @property
    def name(self) -> str:
        return f"threshold {self.threshold:g}, {self.chunk} rays at once, {self.ops}" + (self.also and f", {self.also}")

    @contextmanager
    def applied(self, model: MMPIModel) -> Iterator[None]:
        """Renders so within the block, and as before after it."""
        usual, model.config = model.config, copy.deepcopy(model.config)
        try:
            model.config.rendering.threshold, model.config.eval_num_rays_per_chunk = self.threshold, self.chunk
            if self.also:
                path, _, text = self.also.partition("=")
                group, _, name = path.rpartition(".")
                settings = attrgetter(group)(model.config) if group else model.config
                setattr(settings, name, type(getattr(settings, name))(text))
            dispatch.choose(self.ops)  # type: ignore[arg-type]
            yield
        finally:
            model.config = usual
            dispatch.choose(usual.ops)


@dataclass
class Render(Bench):
    """Rays/s and frames/s against loss of PSNR and against error with respect to exact arithmetic.

    The exact image is made in float64 by plain torch, with every sample kept, for some rays of the test images.
    Settings take turns, so that a busy moment of the machine does not fall on one of them.
    """

    load_config: Path
    """The run's config.yml."""
    thresholds: tuple[float, ...] = (0.0, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2)
    """Weights below which samples are not coloured."""
    chunks: tuple[int, ...] = (1024, 2048, 4096, 8192, 32768)
    """Rays rendered at once."""
    ops: tuple[str, ...] = ("native", "torch")
    """Inner loops (on a CPU)."""
    also: tuple[str, ...] = ()
    """Further settings of the model to try one at a time, as group.name=value."""
    images: int = 4
    """Test images, evenly spaced."""
    rounds: int = 3
    """Times that every setting renders them; the median counts."""
    exact_rays: int = 1000
    """Random rays of those images that are rendered exactly."""

    name = "render"

    def run(self) -> None:
        pipeline = load_model(self.load_config)
        model, images = pipeline.model, list(images_of(pipeline, self.images))
        checkpoint = sorted((self.load_config.parent / "nerfstudio_models").glob("*.ckpt"))[-1]
        stat = checkpoint.stat()
        made = f"{checkpoint.name} {stat.st_size} {stat.st_mtime_ns} {self.images} {self.exact_rays}"
        report = Report(self, f"{fingerprint()} {made}")
        default = Setting(model.config.rendering.threshold, model.chunk_size, _ops_in_use(model))
        rays = _some_rays(images, self.exact_rays)
        exact = report.kept.get("exact") or exact_colors(model, images, rays).tolist()
        facts = {"exact": exact, "default": default.name, "device": str(model.device)}
        report.content |= {**facts, "pixels": int(images[0][1].shape[0] * images[0][1].shape[1])}
        report.save()
        wanted = [s for s in self._settings(default) if s.name not in report.rows]
        for number in range(self.rounds if wanted else 0):
            for setting in wanted:
                row = report.rows.setdefault(setting.name, {**asdict(setting), "frame_s": []})
                with setting.applied(model):
                    row |= measure(model, images, rays, np.array(exact), row["frame_s"])
                rate = 1 / statistics.median(row["frame_s"])
                print(f"[{number + 1}/{self.rounds}] {setting.name}: {rate:.2f} frames/s", flush=True)
        head = headline(report.content)
        report.finish(head, markdown(report.content, head), lambda path: draw(path, report.content))
        print(head)

    def _settings(self, default: Setting) -> list[Setting]:
        """The default, then one thing at a time, and every threshold under every ops."""
        found = [default]
        found += [Setting(t, default.chunk, default.ops) for t in self.thresholds]
        found += [Setting(default.threshold, c, default.ops) for c in self.chunks]
        if default.ops in self.ops:  # elsewhere than on a CPU there is one path
            found += [Setting(t, default.chunk, ops) for ops in self.ops for t in (default.threshold, 0.0)]
        found += [Setting(default.threshold, default.chunk, default.ops, a) for a in self.also]
        return list(dict.fromkeys(found))


def _ops_in_use(model: MMPIModel) -> str:
    """What auto chose."""
    if model.device.type != "cpu":
        return "auto"
    return "native" if dispatch.form_of("march", torch.zeros(1)) == "cpu" else "torch"


def _some_rays(images: list[Image], count: int) -> list[Array]:
    """Pixels (row, column) of each image [N, 2], drawn without repetition."""
    rng, found = np.random.default_rng(0), []
    for i, (_, truth) in enumerate(images):
        share, (height, width) = count // len(images) + (i < count % len(images)), truth.shape[:2]
        found.append(np.stack(divmod(rng.permutation(height * width)[:share], width), -1))
    return found


@torch.no_grad()
def exact_colors(model: MMPIModel, images: list[Image], rays: list[Array]) -> Array:
    """Colours [N, 3] of some pixels, in float64, without dropping anything, over the model's background."""
    field = copy.deepcopy(model.field).cpu().double()
    colors = []
    for (camera, _), pixels in zip(images, rays, strict=True):
        bundle = camera.generate_rays(camera_indices=0, keep_shape=True)[tuple(torch.from_numpy(pixels).T)]
        rays64 = in_float64(bounded(bundle, field.plan))
        for part in (rays64[i : i + EXACT_RAYS] for i in range(0, len(rays64), EXACT_RAYS)):
            found = render_plainly(field, part, blends=field.blends)
            behind = found.composite.transmittance * BACKGROUNDS[model.config.rendering.background]
            colors.append((found.rgb + behind).clamp(0, 1).numpy())
    return np.concatenate(colors)


@torch.no_grad()
def measure(model: MMPIModel, images: list[Image], rays: list[Array], exact: Array, seconds: list[float]) -> Row:
    """Renders the images with the settings that the model has now.

    Returns:
        frame_s: ``seconds`` and those of these frames; psnr: mean; largest and 99.9-percentile error of a colour.
    """
    metrics, psnr, found, spent = ImageMetrics("none"), [], [], list(seconds)
    for (camera, truth), pixels in zip(images, rays, strict=True):
        start = time.perf_counter()
        rgb = model.get_outputs_for_camera(camera)["rgb"].cpu()  # waits for a GPU
        spent.append(time.perf_counter() - start)
        psnr.append(metrics(rgb, truth)["psnr"])
        found.append(rgb.double().numpy()[pixels[:, 0], pixels[:, 1]])
    error = np.abs(np.concatenate(found) - exact)
    errors = {"max_error": float(error.max()), "error_999": float(np.quantile(error, 0.999))}
    return {"frame_s": spent, "psnr": float(np.mean(psnr)), **errors}


def _rows(content: Row) -> list[Row]:
    """Settings with rays/s, what they lose against the best that keeps every sample, and whether none beats them."""
    rows = [{**r, "name": n, "fps": 1 / statistics.median(r["frame_s"])} for n, r in content["rows"].items()]
    best = [r["psnr"] for r in rows if r["threshold"] == 0 and not r["also"]] or [max(r["psnr"] for r in rows)]
    for row in rows:
        row |= {"rays_per_s": row["fps"] * content["pixels"], "loss": best[0] - row["psnr"]}
    for row in rows:
        row["on_front"] = not any(_beats(other, row) for other in rows)
    return rows


def _beats(a: Row, b: Row) -> bool:
    """Faster beyond noise, and no more error either way of measuring it."""
    faster = a["rays_per_s"] > NOISE * b["rays_per_s"]
    return faster and a["loss"] <= b["loss"] + SAME_DB and a["error_999"] <= 1.01 * b["error_999"]


def headline(content: Row) -> dict[str, float]:
    """Figures of the default settings."""
    rows = _rows(content)
    default = next(r for r in rows if r["name"] == content["default"])
    rivals = [r["rays_per_s"] for r in rows if r["loss"] <= default["loss"] + SAME_DB]
    return {
        **{name: default[name] for name in ("rays_per_s", "fps", "max_error", "error_999")},
        "psnr_loss_db": default["loss"],
        "default_on_front": int(default["on_front"]),
        "fastest_at_no_more_loss_over_default": max(rivals) / default["rays_per_s"],
        "exact_rays": len(content["exact"]),
    }


def markdown(content: Row, head: Row) -> str:
    """The page."""
    columns = {
        "setting": lambda r: f"**{r['name']}** (default)" if r["name"] == content["default"] else r["name"],
        "rays/s": "{rays_per_s:.0f}",
        "frames/s": "{fps:.2f}",
        "PSNR": "{psnr:.3f}",
        "loss, dB": "{loss:.4f}",
        "99.9 % of errors below": "{error_999:.1e}",
        "largest error": "{max_error:.1e}",
        "front": lambda r: "yes" if r["on_front"] else "no",
    }
    verdict = "is on" if head["default_on_front"] else "is **not** on"
    said = f"""\
Images of {content["pixels"]} pixels on {content["device"]}. Loss of PSNR is against the same model with every sample
kept; errors of colours (0 to 1) are against {head["exact_rays"]} rays in float64 with every sample kept. The default
{verdict} the front: a setting that is off it is beaten by one that is faster by more than {100 * (NOISE - 1):.0f} % and
has no more error by PSNR nor by the 99.9 percentile."""
    rows = sorted(_rows(content), key=lambda r: -r["rays_per_s"])
    picture = "![Frames per second against error](render.png)"
    return page("Rendering: speed against error", content["made"], said, picture, table(columns, rows))


def draw(path: Path, content: Row) -> None:
    """Frames per second against loss of PSNR and against the two errors; the front is joined."""
    rows = _rows(content)
    titles = (("loss", "loss of PSNR, dB"), ("error_999", "99.9 % of errors below"), ("max_error", "largest error"))
    with figure(path, 1, 3, (15, 4.5), sharey=True) as (axes,):
        for axis, (what, along) in zip(axes, titles, strict=True):
            front = sorted((r[what], r["fps"]) for r in rows if r["on_front"])
            last = what == "max_error"
            axis.plot(*zip(*front, strict=True), color="0.8", lw=4, zorder=0, label="front" if last else None)
            for r in rows:
                mark, size = ("*", 14) if r["name"] == content["default"] else ("o", 6)
                axis.plot(r[what], r["fps"], mark, ms=size, label=r["name"] if last else None)
            # Leaving out what training left out may gain PSNR.
            axis.set(xscale="linear" if what == "loss" else "log", yscale="log", xlabel=along)
        axes[0].set_ylabel("frames/s")
        axes[-1].legend(fontsize=6, loc="upper left", bbox_to_anchor=(1, 1))


if __name__ == "__main__":
    sys.exit(run("render", Render))
