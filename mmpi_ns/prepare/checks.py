"""Checks of a prepared scene: misplaced, blurred or moving frames, and intrinsics that do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from mmpi_ns.prepare.alignment import degrees_between
from mmpi_ns.prepare.evidence import local_median
from mmpi_ns.prepare.images import in_short
from mmpi_ns.prepare.mapping import adjust, bundle_options, is_bent
from mmpi_ns.prepare.polish import with_fewer_points
from mmpi_ns.prepare.stages import PrepareError

Array = NDArray[np.float64]
SIDE = 640
"""Longer side, in pixels, at which sharpness is measured."""
BLURRED = 0.4
"""Fraction of its neighbours' sharpness below which an image counts as blurred."""
JUMP = 5.0
"""Times its neighbours' step (or turn) from which a step counts as a jump."""
TURN = 8.0
"""Minimum angle of such a turn, degrees."""
CELLS = (6, 8)
"""Rows and columns of the grid for coverage and motion."""
MOVED_PX = 4.0
"""Distance from its epipolar line, in pixels of an image 640 wide, from which a match counts as moving."""
LEAST_CELLS = 3
"""Moving cells of an image from which they are reported; one or two are as often wrong matches."""
FOCAL_OFF = (0.03, 0.05)
"""Relative change of a given focal length, when refined, from which it is doubted, and the scene with it..."""
FOCAL_HELPS = (0.95, 0.85)
"""... if refining it lowers the reprojection error below these fractions."""


@dataclass(frozen=True)
class Finding:
    """A warning."""

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


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Gray image.

    Raises:
        PrepareError: the file cannot be read.
    """
    gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if gray is None:
        raise PrepareError(f"{path.name} cannot be read: repair or remove it.")
    return gray  # type: ignore[return-value]


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
    found = []
    for i in range(len(steps)):
        where = f"between {names[i]} and {names[i + 1]}"
        if steps[i] > JUMP * usual_step[i] + floor:
            times = steps[i] / max(usual_step[i], 1e-12)
            found.append(Finding("misplaced?", names[i + 1], f"a step of {times:.0f} usual ones {where}", times))
        elif turns[i] > JUMP * usual_turn[i] + TURN:
            found.append(Finding("misplaced?", names[i + 1], f"a turn of {turns[i]:.0f} degrees {where}", turns[i]))
    return found


def coverage(model: pycolmap.Reconstruction) -> dict[str, float]:
    """Fraction of an image's cells that contain a keypoint with a point, for each image."""
    shares = {}
    for i in model.reg_image_ids():
        image = model.images[i]
        camera = model.cameras[image.camera_id]
        seen = np.array([p.xy for p in image.points2D if p.has_point3D()]).reshape(-1, 2)
        shares[image.name] = float(_cell_counts(seen, camera.width, camera.height).astype(bool).mean())
    return shares


def _cells(points: Array, width: int, height: int) -> NDArray[np.int64]:
    """Number of the cell of each pixel position. [N]"""
    rows, columns = CELLS
    row = np.clip(points[:, 1] / height * rows, 0, rows - 1).astype(int)
    return row * columns + np.clip(points[:, 0] / width * columns, 0, columns - 1).astype(int)


def _cell_counts(points: Array, width: int, height: int) -> NDArray[np.int64]:
    return np.bincount(_cells(points, width, height), minlength=CELLS[0] * CELLS[1])


def moving(model: pycolmap.Reconstruction, database: Path, names: Sequence[str]) -> list[Finding]:
    """Images in which clustered matches with the next image leave their epipolar lines: something moves there.

    Motion along the epipolar line (a car driving ahead) is not detected.
    """
    by_name = {model.images[i].name: i for i in model.reg_image_ids()}
    found = []
    with pycolmap.Database.open(database) as opened:
        for name, after in pairwise(names):
            pair = by_name[name], by_name[after]
            if not opened.exists_matches(*pair):
                continue
            matches = np.asarray(opened.read_matches(*pair)).astype(int)
            if len(matches) < 30:
                continue
            share = _moving_share(model, pair, matches)
            if share >= LEAST_CELLS / (CELLS[0] * CELLS[1]):
                says = f"{share:.0%} of the image's cells do not follow the camera's motion: mask it (--masks)"
                found.append(Finding("moving?", name, says, share))
    return found


def _moving_share(model: pycolmap.Reconstruction, pair: tuple[int, int], matches: NDArray[np.int64]) -> float:
    """Share of the first image's cells where most of at least six matches are off their epipolar lines, alike."""
    images = [model.images[i] for i in pair]
    cameras = [model.cameras[image.camera_id] for image in images]
    pixels = [np.array([p.xy for p in image.points2D])[matches[:, k]] for k, image in enumerate(images)]
    rays = [np.c_[c.cam_from_img(p), np.ones(len(p))] for c, p in zip(cameras, pixels, strict=True)]
    relative = images[1].cam_from_world() * images[0].cam_from_world().inverse()
    essential = pycolmap.essential_matrix_from_pose(relative)
    lines = rays[0] @ essential.T
    off = np.abs((lines * rays[1]).sum(-1)) / np.maximum(np.linalg.norm(lines[:, :2], axis=-1), 1e-12)
    bad = off * cameras[1].mean_focal_length() * SIDE / cameras[1].width > MOVED_PX
    cell = _cells(pixels[0], cameras[0].width, cameras[0].height)
    flow = pixels[1] - pixels[0]
    count = 0
    for number in np.unique(cell[bad]):
        own = cell == number
        if own.sum() >= 6 and bad[own].mean() > 0.6:
            spread = np.median(np.abs(flow[own & bad] - np.median(flow[own & bad], axis=0)), axis=0)
            # wrong matches point everywhere; a moving object moves as one
            count += int(spread.max() < 0.01 * cameras[0].width)
    return count / (CELLS[0] * CELLS[1])


def doubtful_intrinsics(model: pycolmap.Reconstruction, fixed: bool, threads: int) -> list[Finding]:
    """Models, focal lengths and lenses that do not fit.

    Args:
        model: the final model.
        fixed: intrinsics were given and kept; they are refined in a copy and compared.
        threads: CPU threads; below 1 for all.
    """
    found = []
    if is_bent(model):
        error = model.compute_mean_reprojection_error()
        found.append(Finding("bent?", "", f"a reprojection error of {error:.2f} px is high: the track may be wrong"))
    if fixed:
        free = with_fewer_points(model)
        before = free.compute_mean_reprojection_error()
        adjust(free, bundle_options(True, True, False, threads, robust=True))
        after = free.compute_mean_reprojection_error()
        for number, camera in model.cameras.items():
            given, fits = camera.mean_focal_length(), free.cameras[number].mean_focal_length()
            doubted, grave = (
                abs(fits / given - 1) > off and after < helps * before
                for off, helps in zip(FOCAL_OFF, FOCAL_HELPS, strict=True)
            )
            if doubted:
                says = f"the given focal length {given:.1f} px does not fit: {fits:.1f} px would bring the error"
                found.append(Finding("intrinsics?", "", f"{says} from {before:.2f} to {after:.2f} px", is_grave=grave))
    for camera in model.cameras.values():
        ratio = camera.mean_focal_length() / max(camera.width, camera.height)
        if not 0.3 < ratio < 4:
            found.append(Finding("intrinsics?", "", f"a focal length of {ratio:.2f} image sides is unusual"))
    return found
