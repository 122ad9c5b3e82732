"""report.md: the result in figures and words, with a top view of the track."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from matplotlib.figure import Figure

from mmpi_ns.capture.exif import light_of
from mmpi_ns.prepare.alignment import camera_poses
from mmpi_ns.prepare.checks import Finding
from mmpi_ns.utils.files import write_text

WORST = 5
"""Number of images with the least coverage that are listed."""
CELLS = (8, 6)
"""Columns and rows of the grid for coverage."""


def exposure_in_words(images: Sequence[Path]) -> str:
    """Range of the exposures of images by their EXIF, in words."""
    light = [x for x in map(light_of, images) if np.isfinite(x)]
    if not light:
        return "not known: no EXIF"
    return f"varies {max(light) / min(light):.1f}-fold by the EXIF of {len(light)} images"


def write_report(
    model: pycolmap.Reconstruction,
    title: str,
    rows: dict[str, str],
    findings: Sequence[Finding],
    warnings: Sequence[str],
    note: str,
    scene: Path,
) -> None:
    """Writes report.md and report/track.png.

    Args:
        model: in the frame of the scene.
        title: of the report.
        rows: what the table says beyond the model's figures, by their names.
        findings: of the checks; listed as warnings and marked in the drawing.
        warnings: further ones, listed first.
        note: the last line.
        scene: folder to write to.
    """
    covered = {}  # share of each image's cells that hold a keypoint with a point
    for i in model.reg_image_ids():
        image, camera = model.images[i], model.cameras[model.images[i].camera_id]
        seen = np.array([p.xy for p in image.points2D if p.has_point3D()]).reshape(-1, 2)
        cell = (np.clip(seen / [camera.width, camera.height], 0, 1 - 1e-9) * CELLS).astype(int)
        covered[image.name] = len(np.unique(cell, axis=0)) / (CELLS[0] * CELLS[1])
    rows = rows | {
        "reprojection error": f"{model.compute_mean_reprojection_error():.3f} px",
        "points": f"{model.num_points3D()}",
        "track length": f"{model.compute_mean_track_length():.1f} images",
        "points seen by an image": f"{model.compute_mean_observations_per_reg_image():.0f}",
        "coverage": f"{np.mean(list(covered.values())):.0%} on average, {min(covered.values()):.0%} at least",
    }
    by_badness = sorted(findings, key=lambda f: (f.kind, -f.badness))
    warnings = [*warnings, *(f"{f.kind} {f.image + ': ' if f.image else ''}{f.says}" for f in by_badness)]
    parts = [
        f"# {title}\n",
        "\n".join(["| | |", "|---|---|", *(f"| {k} | {v} |" for k, v in rows.items())]),
        "\n## Warnings\n",
        "\n".join(f"- {w}" for w in warnings) or "None.",
        "\n## Track from above\n\n![track](report/track.png)\n",
        *(["## What moves\n\n![masks](report/moving.jpg)\n"] if (scene / "report/moving.jpg").is_file() else []),
        "## Cameras\n",
        *(
            f"- {c.model.name} {c.width}x{c.height}: {c.params_info} = {', '.join(f'{v:.5g}' for v in c.params)}"
            for _, c in sorted(model.cameras.items())
        ),
        "\n## Coverage\n",
        "Share of an image's cells (8 x 6) that hold a keypoint with a point; the least:\n",
        *(f"- {n}: {v:.0%}" for n, v in sorted(covered.items(), key=lambda x: x[1])[:WORST]),
        "\n## Notes\n",
        f"- {note}",
    ]
    write_text(scene / "report.md", "\n".join(parts) + "\n")
    _draw_track(model, findings, scene / "report" / "track.png")


def _draw_track(model: pycolmap.Reconstruction, findings: Sequence[Finding], path: Path) -> None:
    """Cameras and points from above."""
    path.parent.mkdir(exist_ok=True)
    names, poses = camera_poses(model)
    # Two axes across the cameras' mean up, whatever frame the scene is in; its own where one of them is about vertical.
    up = -poses[:, :3, 1].mean(0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    vertical = np.argmax(np.abs(up))
    if abs(up[vertical]) > 0.9:
        pair = np.eye(3)[[i for i in range(3) if i != vertical]]
        axes = (pair[::-1] if np.dot(np.cross(*pair), up) < 0 else pair).T
    else:
        right = np.linalg.svd(np.eye(3) - np.outer(up, up))[0][:, 0]
        axes = np.stack([right, np.cross(up, right)], -1)
    centers, facing = poses[:, :3, 3] @ axes, poses[:, :3, 2] @ axes
    points = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3) @ axes
    reach = 0.6 * max(float(np.ptp(centers, axis=0).max()), 1e-9)
    low, high = centers.min(0) - reach, centers.max(0) + reach
    figure = Figure(figsize=(8, 8), layout="constrained")
    plot = figure.add_subplot(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    plot.plot(*points.T, ",", color="0.55")
    plot.plot(*centers.T, "-", color="tab:blue", linewidth=1)
    plot.quiver(*centers.T, *facing.T, color="tab:blue", angles="xy", width=0.002, scale=40)
    marked = [names.index(f.image) for f in findings if f.image in names and f.kind == "misplaced?"]
    plot.plot(*centers[marked].T, "o", color="tab:red", fillstyle="none", label="misplaced?")
    plot.annotate(names[0], centers[0])
    plot.annotate(names[-1], centers[-1])
    figure.savefig(path, dpi=110)
