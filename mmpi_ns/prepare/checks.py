"""Checks of a prepared scene: misplaced or blurred frames, and intrinsics that do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from mmpi_ns.prepare.adjustment import WIDE, adjust, focal_in_words, with_fewer_points
from mmpi_ns.prepare.alignment import Array, degrees_between
from mmpi_ns.prepare.evidence import local_median
from mmpi_ns.prepare.images import in_short
from mmpi_ns.prepare.mapping import is_bent

SIDE = 640
"""Longer side, in pixels, at which sharpness is measured."""
BLURRED = 0.4
"""Fraction of its neighbours' sharpness below which an image counts as blurred."""
JUMP = 5.0
"""Times its neighbours' step (or turn) from which a step counts as a jump."""
TURN = 8.0
"""Minimum angle of such a turn, degrees."""
FOCAL_OFF = (0.03, 0.05)
"""Relative change of a given focal length, when refined, from which it is doubted, and the scene with it..."""
FOCAL_HELPS = (0.95, 0.85)
"""... if refining it lowers the reprojection error below these fractions."""


@dataclass(frozen=True)
class Finding:
    """Warning of a check."""

    kind: str
    """One word and a question mark: the suspected problem."""
    image: str
    """Empty for the scene as a whole."""
    says: str
    badness: float = 1.0
    """Sorts findings of a kind."""
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
        rest = f"; then {in_short([f.image or f.says for f in others], 6)}" if others else ""
        lines.append(f"{kind} {image}{worst.says}{rest}")
    return lines


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over that of the image, at a fixed size: independent of contrast, lowered by blur."""
    scale = SIDE / max(gray.shape)
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    values = gray.astype(np.float32)
    return float(cv2.Laplacian(values, cv2.CV_32F).var() / max(float(values.var()), 1.0))


def blurred(names: Sequence[str], sharp: Array, ordered: bool) -> list[Finding]:
    """Images much less sharp than their neighbours (or than all others, if the images are not in order)."""
    usual = local_median(sharp, 7) if ordered else np.full(len(sharp), np.median(sharp))
    share = sharp / np.maximum(usual, 1e-12)
    what = "its neighbours" if ordered else "the others"
    return [
        Finding("blurred?", names[i], f"{share[i]:.0%} as sharp as {what}", -share[i])
        for i in range(len(names))
        if share[i] < BLURRED
    ]


def misplaced(names: Sequence[str], places: Sequence[int], poses: Array) -> list[Finding]:
    """Frames of a sequence where the track jumps or the camera turns abruptly.

    Args:
        names: images in order.
        places: their indices in the input, so that a gap of two frames may be twice as long.
        poses: camera to world, OpenCV axes. [N, 4, 4]
    """
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
    model: pycolmap.Reconstruction, is_fixed: bool, focal: tuple[float, float] | None, threads: int
) -> list[Finding]:
    """Models, focal lengths and lenses that do not fit.

    Args:
        model: the final model.
        is_fixed: intrinsics were given and kept; they are refined in a copy and compared.
        focal: the interval of the focal length in pixels, where it was refined.
        threads: CPU threads; below 1 for all.
    """
    findings = []
    if focal is not None and focal[1] - focal[0] >= WIDE * focal[1]:
        says = f"the images hardly determine the focal length ({focal_in_words(*focal)})"
        findings.append(Finding("intrinsics?", "", f"{says}: give --focal if you know it"))
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
                says = f"the given focal length {fixed:.1f} px does not fit: {fitted:.1f} px would bring the error"
                says = f"{says} from {before:.2f} to {after:.2f} px"
                findings.append(Finding("intrinsics?", "", says, is_grave=is_grave))
    for camera in model.cameras.values():
        ratio = camera.mean_focal_length() / max(camera.width, camera.height)
        if not 0.3 < ratio < 4:
            findings.append(Finding("intrinsics?", "", f"a focal length of {ratio:.2f} image sides is unusual"))
    return findings
