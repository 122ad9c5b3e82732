"""The contact sheet: a trained run in one picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import matplotlib
import numpy as np
from maps import Map
from painting import FAINT, WORST_ERROR, depth_colors, error_colors, image_of, over_checks, rgb8, scale_bar, write
from PIL import Image, ImageDraw
from views import Picture, Run, View, render_alone, render_view, truth_of

from mmpi_ns.placement.observations import Array
from mmpi_ns.placement.show import describe_facing
from mmpi_ns.scene.plan import CubePlan

LABELS, VIEW, GAP = 400, 360, 6
"""Widths of the column of labels and of a view, and the space between pictures; pixels."""


@dataclass(frozen=True)
class Shown:
    """A test view with all its pictures on the sheet."""

    index: int
    """Of the test image."""
    truth: Picture
    view: View
    alone: list[Picture]
    """[H, W, 4] of each MPI."""

    @property
    def psnr(self) -> float:
        """Decibels."""
        return float(-10 * np.log10(max(float(((self.truth - self.view.color) ** 2).mean()), 1e-12)))


def spread(count: int, wanted: int = 3) -> list[int]:
    """Some of ``count`` images, evenly spread."""
    wanted = min(count, wanted)
    return sorted({round((k + 0.5) * count / wanted - 0.5) for k in range(wanted)})


def show_views(
    run: Run, indices: list[int], progress: Callable[[Iterable[tuple[int, str]]], Iterable[tuple[int, str]]] = iter
) -> list[Shown]:
    """Renders test views, by all MPIs and by each one alone; ``progress`` wraps the renderings."""
    names = ["all", *run.windows.names]
    shown: list[Shown] = []
    for index, name in progress([(i, name) for i in indices for name in names]):
        camera = run.tests.cameras[index : index + 1]
        if name == "all":
            shown.append(Shown(index, truth_of(run, index), render_view(run, camera), []))
        else:
            shown[-1].alone.append(render_alone(run, camera, name))
    return shown


def contact_sheet(run: Run, shown: list[Shown]) -> Image.Image:
    """Truth, rendering, error, depth and winning MPI, then each MPI alone with its place on the map."""
    rows = [*_whole_rows(run, shown), *_alone_rows(run, shown)]
    header = _header(run, len(shown))
    heights = [max(label.height, max(p.height for p in pictures)) for label, pictures in rows]
    width = LABELS + len(shown) * (VIEW + GAP) + GAP
    sheet = Image.new("RGB", (width, header.height + sum(heights) + GAP * (len(rows) + 1)), "white")
    sheet.paste(header, (0, 0))
    y = header.height
    for (label, pictures), height in zip(rows, heights, strict=True):
        sheet.paste(label, (0, y))
        for k, picture in enumerate(pictures):
            sheet.paste(picture, (LABELS + k * (VIEW + GAP), y))
        y += height + GAP
    return sheet


def overview(run: Run, shown: Shown) -> Image.Image:
    """Half a sheet for the impatient: one view, and where all MPIs stand."""
    width, line = 440, 22
    parts = [
        ("ground truth (test image)", image_of(shown.truth, width)),
        (f"rendering, {shown.psnr:.1f} dB", image_of(shown.view.color, width)),
        ("depth: near is bright", image_of(depth_colors(shown.view.inverse_depth, nearest_of([shown])), width)),
        ("winning MPI: largest weight in a pixel", image_of(_winner_colors(run, shown.view), width)),
    ]
    height = parts[0][1].height + line
    top_view = Map.of(run.observations, 2 * width + GAP, 220)
    from_above = top_view.draw(list(zip(run.heads, run.colors, strict=True)), _places(run, [shown]))
    picture = Image.new("RGB", (2 * width + 3 * GAP, 2 * (height + GAP) + line + from_above.height + GAP), "white")
    draw = ImageDraw.Draw(picture)
    for k, (text, image) in enumerate(parts):
        x, y = GAP + (k % 2) * (width + GAP), (k // 2) * (height + GAP)
        write(draw, (x, y + 3), text)
        picture.paste(image, (x, y + line))
    y = 2 * (height + GAP)
    count = len(run.windows.names)
    text = f"from above: training cameras (black), points of the scene (gray), this view (A), {count} MPIs (colours)"
    write(draw, (GAP, y + 3), text)
    picture.paste(from_above, (GAP, y + line))
    return picture


def _header(run: Run, views: int) -> Image.Image:
    cubes = sum(isinstance(head, CubePlan) for head in run.heads)
    count = f"{len(run.heads) - cubes} multi-plane images (MPIs){' and a cube' if cubes else ''}"
    text = (
        f"This scene consists of {count}. Each is a stack of semi-transparent planes that face one way,\ndense near "
        "its origin (cross on the maps) and sparse far away. An MPI is sharp for views just past its origin: follow a "
        "column down\nto see which one that is; it has the largest weight there. The rendering samples all MPIs along "
        "each ray and composites\nthe samples by distance. Black dots are training cameras, A, B, ... the test views."
    )
    header = Image.new("RGB", (LABELS + views * (VIEW + GAP) + GAP, 138), "white")
    draw = ImageDraw.Draw(header)
    write(draw, (10, 8), "One radiance field made of several multi-plane images", 18, bold=True)
    write(draw, (10, 36), text, 13)
    for k in range(views):
        write(draw, (LABELS + k * (VIEW + GAP), 118), f"test view {chr(ord('A') + k)}", 14, bold=True)
    return header


def _label(title: str, text: str, height: int, extra: Image.Image | None = None) -> Image.Image:
    label = Image.new("RGB", (LABELS, height), "white")
    draw = ImageDraw.Draw(label)
    write(draw, (10, 2), title, 15, bold=True)
    write(draw, (10, 24), text, 13, fill=FAINT)
    if extra is not None:
        label.paste(extra, (10, height - extra.height))
    return label


def _whole_rows(run: Run, shown: list[Shown]) -> list[tuple[Image.Image, list[Image.Image]]]:
    views = [s.view for s in shown]
    size = image_of(shown[0].truth, VIEW).height
    nearest = nearest_of(shown)
    errors = [np.abs(s.truth - s.view.color).mean(-1) for s in shown]
    scores = ", ".join(f"{s.psnr:.1f}" for s in shown)
    ticks = [
        (0.0, "∞"),
        *((p, f"{nearest / p:.0f} m" if p < 1 else f"{nearest:.0f} m or less") for p in (0.25, 0.5, 1)),
    ]
    depth_bar = scale_bar(_ramp("viridis"), 300, 12, ticks)
    error_ticks = [(0.0, "0"), (0.5, f"{WORST_ERROR / 2:.2f}"), (1.0, f"{WORST_ERROR:.1f} or more")]
    error_bar = scale_bar(_ramp("inferno"), 300, 12, error_ticks)
    return [
        (_label("Ground truth", "test images, not used for training", size), [image_of(s.truth, VIEW) for s in shown]),
        (
            _label("Rendering", f"all MPIs merged by distance, with details\nPSNR {scores} dB", size),
            [image_of(v.color, VIEW) for v in views],
        ),
        (
            _label("Error", "mean of |truth - rendering| over red, green, blue", size, error_bar),
            [image_of(error_colors(e), VIEW) for e in errors],
        ),
        (
            _label("Depth", "distance at which half of a ray's weight is reached", size, depth_bar),
            [image_of(depth_colors(v.inverse_depth, nearest), VIEW) for v in views],
        ),
        (
            _label("Winning MPI", "the MPI with the largest weight in a pixel;\nfor the colours see below", size),
            [image_of(_winner_colors(run, v), VIEW) for v in views],
        ),
    ]


def _alone_rows(run: Run, shown: list[Shown]) -> list[tuple[Image.Image, list[Image.Image]]]:
    size = image_of(shown[0].truth, VIEW).height
    drawn = Map.of(run.observations, LABELS - 22, max(60, size - 46))
    marks = _places(run, shown)
    rows = []
    for k, (head, color) in enumerate(zip(run.heads, run.colors, strict=True)):
        won = 100 * float(np.mean([(s.view.winner == k).mean() for s in shown]))
        facing = "all round"
        if not isinstance(head, CubePlan):
            facing = describe_facing(np.asarray(head.axes[2]), run.observations.mean_axes)
        label = Image.new("RGB", (LABELS, size), "white")
        draw = ImageDraw.Draw(label)
        draw.rectangle([10, 4, 24, 18], fill=rgb8(color))
        name = "cube" if isinstance(head, CubePlan) else f'MPI "{run.windows.names[k]}"'
        write(draw, (32, 2), f"{name} alone", 15, bold=True)
        empty = max(float((v.alone[k][..., 3] < 0.5).mean()) for v in shown) > 0.01
        text = f"facing {facing}; wins {won:.0f} % of the pixels{'; checkerboard: empty' if empty else ''}"
        write(draw, (10, 23), text, 12, fill=FAINT)
        label.paste(drawn.draw([(head, color)], marks), (10, size - drawn.size[1]))
        rows.append((label, [image_of(over_checks(s.alone[k]), VIEW) for s in shown]))
    return rows


def _places(run: Run, shown: list[Shown]) -> Array:
    """[N, 3] where the views stand."""
    poses = run.tests.cameras.camera_to_worlds[[s.index for s in shown]]
    return poses[:, :, 3].double().cpu().numpy()


def _winner_colors(run: Run, view: View) -> Picture:
    return np.asarray(run.colors, np.float32)[view.winner]


def nearest_of(shown: list[Shown]) -> float:
    """A distance that nearly all pixels of some views lie beyond, in units of the capture."""
    return float(1 / np.quantile(np.concatenate([s.view.inverse_depth.ravel() for s in shown]), 0.98))


def _ramp(name: str) -> np.ndarray:
    return matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3].astype(np.float32)
