"""Checks of a prepared scene: misplaced or blurred frames, and intrinsics that do not fit; and report.md, the result in
figures and words, with a top view of the track.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from matplotlib.figure import Figure

from mmpi_ns.utils.files import write_text
from mmpi_prepare.adjustment import WIDE, Array, adjust, camera_poses, degrees_between, is_bent, with_fewer_points
from mmpi_prepare.evidence import local_median
from mmpi_prepare.images import in_short

BLURRED, BESIDE = 0.4, 3
"""Fraction of its neighbours' sharpness below which a frame counts as blurred, and neighbours on either side."""
JUMP, TURN = 5.0, 8.0
"""Multiple of its neighbours' step (or turn) from which a step counts as a jump; minimum angle of such a turn,
degrees."""
FOCAL_OFF, FOCAL_HELPS = (0.03, 0.05), (0.95, 0.85)
"""Relative change of a given focal length by refinement from which it, and the scene with it, is doubtful, if
refinement lowers the reprojection error below these fractions."""


@dataclass(frozen=True)
class Finding:
    """Warning of a check."""

    kind: str
    """One word and a question mark: the suspected problem."""
    image: str
    """Empty for the scene as a whole."""
    summary: str
    badness: float = 1.0
    """Sort key of findings of a kind."""
    is_grave: bool = False
    """Whether it makes the scene doubtful."""


def by_kind(findings: Sequence[Finding]) -> list[str]:
    """A line for each kind: the worst finding in words, and the other images, worst first."""
    kinds: dict[str, list[Finding]] = {}
    for finding in sorted(findings, key=lambda f: -f.badness):
        kinds.setdefault(finding.kind, []).append(finding)
    lines = []
    for kind, (worst, *others) in kinds.items():
        image = f"{worst.image}: " if worst.image else ""
        rest = f"; then {in_short([f.image or f.summary for f in others], 6)}" if others else ""
        lines.append(f"{kind} {image}{worst.summary}{rest}")
    return lines


def blurred(names: Sequence[str], sharp: Array) -> list[Finding]:
    """Frames of a sequence that are much less sharp than those before and those after them; less sharp than one side
    alone does not count, as a pan may end at a surface without detail."""
    findings = []
    for i in range(BESIDE, len(names) - BESIDE):
        usual = min(np.median(sharp[i - BESIDE : i]), np.median(sharp[i + 1 : i + 1 + BESIDE]))
        share = float(sharp[i] / max(usual, 1e-12))
        if share < BLURRED:
            summary = f"{share:.0%} as sharp as frames before and after it: leave it out if it looks blurred"
            findings.append(Finding("blurred?", names[i], summary, -share))
    return findings


def misplaced(names: Sequence[str], places: Sequence[int], poses: Array) -> list[Finding]:
    """Frames of a sequence where the track of poses [N, 4, 4] jumps or the camera turns abruptly; ``places`` are their
    indices in the input, so that a gap of two frames may be twice as long."""
    if len(names) < 5:
        return []
    gaps = np.diff(places)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=-1) / gaps
    turns = degrees_between(poses[1:, :3, :3], poses[:-1, :3, :3]) / gaps
    usual_step, usual_turn = local_median(steps, 5), local_median(turns, 5)
    floor = 0.05 * float(np.median(steps))
    findings = []
    for i in range(len(steps)):
        where = f"between {names[i]} and {names[i + 1]}"
        if steps[i] > JUMP * usual_step[i] + floor:
            times = steps[i] / max(usual_step[i], 1e-12)
            findings.append(Finding("misplaced?", names[i + 1], f"a step of {times:.0f} usual ones {where}", times))
        elif turns[i] > JUMP * usual_turn[i] + TURN:
            findings.append(Finding("misplaced?", names[i + 1], f"a turn of {turns[i]:.0f} degrees {where}", turns[i]))
    return findings


def doubtful_intrinsics(
    model: pycolmap.Reconstruction, is_fixed: bool, focal: tuple[float, str] | None, threads: int
) -> list[Finding]:
    """Models, focal lengths (``focal``: the interval in pixels of one that was refined) and lenses that do not fit.
    Fixed intrinsics, which were given, are refined in a copy and compared."""
    findings = []
    if focal is not None and focal[0] >= WIDE:
        summary = f"the images hardly determine the focal length ({focal[1]})"
        findings.append(Finding("intrinsics?", "", f"{summary}: give --focal if you know it"))
    if is_bent(model):
        error = model.compute_mean_reprojection_error()
        findings.append(Finding("bent?", "", f"a reprojection error of {error:.2f} px is high: the track may be wrong"))
    if is_fixed:
        free = with_fewer_points(model)
        before = free.compute_mean_reprojection_error()
        adjust(free, threads, lens=True)
        after = free.compute_mean_reprojection_error()
        for number, camera in model.cameras.items():
            fixed, fitted = camera.mean_focal_length(), free.cameras[number].mean_focal_length()
            is_doubtful, is_grave = (
                abs(fitted / fixed - 1) > off and after < helps * before
                for off, helps in zip(FOCAL_OFF, FOCAL_HELPS, strict=True)
            )
            if is_doubtful:
                summary = f"the given focal length {fixed:.1f} px does not fit: {fitted:.1f} px would bring the error"
                summary = f"{summary} from {before:.2f} to {after:.2f} px"
                findings.append(Finding("intrinsics?", "", summary, is_grave=is_grave))
    for camera in model.cameras.values():
        ratio = camera.mean_focal_length() / max(camera.width, camera.height)
        if not 0.3 < ratio < 4:
            findings.append(Finding("intrinsics?", "", f"a focal length of {ratio:.2f} image sides is unusual"))
    return findings


def write_report(
    model: pycolmap.Reconstruction,
    title: str,
    rows: dict[str, str],
    findings: Sequence[Finding],
    warnings: Sequence[str],
    note: str,
    scene: Path,
) -> None:
    """Writes report.md and report/track.png of a scene: a table of ``rows`` and the model's figures, warnings with the
    findings of the checks, which the drawing marks, and a last note."""
    rows = rows | {
        "reprojection error": f"{model.compute_mean_reprojection_error():.3f} px",
        "points": f"{model.num_points3D()}",
        "track length": f"{model.compute_mean_track_length():.1f} images",
        "points seen by an image": f"{model.compute_mean_observations_per_reg_image():.0f}",
    }
    by_badness = sorted(findings, key=lambda f: (f.kind, -f.badness))
    warnings = [*warnings, *(f"{f.kind} {f.image + ': ' if f.image else ''}{f.summary}" for f in by_badness)]
    cameras = ((c, ", ".join(f"{v:.5g}" for v in c.params)) for _, c in sorted(model.cameras.items()))
    parts = [
        f"# {title}\n\n| | |\n|---|---|",
        *(f"| {k} | {v} |" for k, v in rows.items()),
        "\n## Warnings\n\n" + ("\n".join(f"- {w}" for w in warnings) or "None."),
        "\n## Track from above\n\n![track](report/track.png)\n",
        *(["## What moves\n\n![masks](report/moving.jpg)\n"] if (scene / "report/moving.jpg").is_file() else []),
        "## Cameras\n",
        *(f"- {c.model.name} {c.width}x{c.height}: {c.params_info} = {params}" for c, params in cameras),
        f"\n## Notes\n\n- {note}",
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
