"""Check of cameras against their images: whether matches contradict them, and which convention would fit.

The commonest mistakes in a file of poses are camera axes of another program, world to camera in place of camera to
world, left-handed axes, intrinsics of another image size, and a lens that is left out. Verified matches of features do
not depend on poses. So each mistake is undone on trial, and judged by the distances of the matches from the epipolar
lines: the directions that a camera's axes may have make 24 rotations, each with and without inversion. Epipolar lines
are the same for a mirrored scene; there most points lie behind the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from mmpi_priors import sfm

Array = NDArray[np.float64]

OPENCV, OPENGL = np.eye(3), np.diag([1.0, -1.0, -1.0])
"""Directions of a camera, right, down and forward, in columns, along its axes as a file has them, in rows."""
LLFF = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
PROGRAMS = (("OpenGL's", OPENGL), ("OpenCV's", OPENCV), ("LLFF's", LLFF), ("Unity's", np.diag([1.0, -1.0, 1.0])))
DIRECTIONS = (("right", "left"), ("down", "up"), ("forward", "back"))
MOST, LEAST = 4000, 60
"""Maximum number of matches that are tested, and minimum number for a result."""
BETTER, CHANCE = 0.4, 0.5
"""Share of the error as given to which a convention must lower it; share of the error of wrong conventions from which a
pose fits no better than by chance."""
ALIKE = 1.25
"""Ratio of errors within which the more usual convention is preferred."""
FOCALS = np.geomspace(0.2, 5.0, 17)
"""Focal lengths, over the given one, that are tried."""
FINE = 0.0005
"""Median distance of the matches from the epipolar lines, relative to the image's width, up to which cameras are
right."""
USUAL = 5
"""Readings of the matrices, the most usual, that are tried with other intrinsics."""
PLAUSIBLE, MOST_BENT = (0.25, 5.0), 0.5
"""Plausible ranges of focal length over width and of lens coefficients."""
GRAVE = 0.002
"""Median distance from which cameras are unusable, and up to which other intrinsics fit the matches."""
HOPELESS, SHUFFLES = 0.004, 5
"""Median distance from which cameras that no convention fits are refused; random permutations of the poses for
comparison."""
FOCAL_WRONG = 0.2
"""Log ratio of the fitted and the given focal length from which cameras are unusable."""
SAME_PLACE = 1e-6
"""Fraction of their distance from the origin below which cameras count as one place in float32: without epipolar
lines."""
FAR = 0.01
"""Distance from an epipolar line, relative to the image's width, at which errors are truncated in a fit."""


@dataclass(frozen=True)
class Matches:
    """Matches of N pixels of two images each."""

    images: NDArray[np.int64]
    """[N, 2]"""
    rays: Array
    """[N, 2, 2] in the plane z = 1, OpenCV axes; NaN where the lens has no ray."""
    flat: Array
    """[N, 2, 2] the same without the lens: pixels less the principal point over the focal lengths."""

    @staticmethod
    def of(model: Any, database: Any) -> Matches:
        """A random subset of the verified matches of a model's images, in the order of their ids."""
        pycolmap, order = sfm.load_pycolmap(), {i: n for n, i in enumerate(sorted(model.images))}
        cameras = {i: model.cameras[image.camera_id] for i, image in model.images.items()}
        with pycolmap.Database.open(database) as opened:
            pixels = {i: np.asarray(opened.read_keypoints(i), np.float64).reshape(-1, 6)[:, :2] for i in order}
        rows, places = [], []
        for a, b, matches in sfm.verified_matches(database):
            if a in order and b in order:
                places.append(np.stack([pixels[a][matches[:, 0]], pixels[b][matches[:, 1]]], 1))
                rows.append(np.tile([a, b], (len(matches), 1)))
        if not rows:
            return Matches(np.zeros((0, 2), np.int64), *np.zeros((2, 0, 2, 2)))
        ids, at = np.concatenate(rows), np.concatenate(places)
        if len(ids) > MOST:
            kept = np.sort(np.random.default_rng(0).choice(len(ids), MOST, replace=False))
            ids, at = ids[kept], at[kept]
        rays, flat = np.zeros_like(at), np.zeros_like(at)
        for i, camera in cameras.items():
            held = ids == i
            rays[held] = np.asarray(camera.cam_from_img(at[held])).reshape(-1, 2)
            matrix = camera.calibration_matrix()
            flat[held] = (at[held] - matrix[:2, 2]) / np.diag(matrix)[:2]
        return Matches(np.vectorize(order.__getitem__)(ids).astype(np.int64), rays, flat)


@dataclass(frozen=True)
class Convention:
    """A way to read the matrices and intrinsics of cameras, and how well the matches fit it."""

    axes: Array
    """[3, 3] as ``OPENCV``."""
    inverted: bool = False
    mirrored: bool = False
    """Whether the world is left-handed."""
    focal: float = 1.0
    """Focal length over the given one."""
    moves_center: bool = False
    """Whether the principal point is for another image size, too."""
    bend: tuple[float, float] | None = None
    """Terms of a lens in place of the given one: a ray's tangent over a pixel's, less 1, for r**2 and r**4."""
    error: float = np.inf
    """Median distance of the matches from the epipolar lines, over the image's width."""

    def applied(self, matrices: Array) -> Array:
        """Camera to world with OpenCV axes of the matrices of a file. [M, 4, 4]"""
        poses = np.linalg.inv(matrices) if self.inverted else matrices.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ self.axes
        if self.mirrored:
            poses[:, 2] *= -1
        return poses

    def is_of_axes(self, given: Array) -> bool:
        """Whether it differs from the given one in the matrices, not only in the intrinsics."""
        return self.inverted or self.mirrored or not np.array_equal(self.axes, given)


def misfit(poses: Array, lens: tuple[Array, Array, Array], matches: Matches) -> float:
    """Median distance of matches from the epipolar lines of camera poses, OpenCV axes [M, 3, 4], over the width; NaN
    without any.

    Unlike reprojection errors of points it is not truncated: matches that fit the poses badly never become points.
    """
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :3] = poses
    return _Problem(matrices, lens, matches).judged(Convention(OPENCV)).error


def find_convention(
    matrices: Array, given: Array, lens: tuple[Array, Array, Array], matches: Matches
) -> tuple[Convention, Convention | None, bool]:
    """Fit of matches to cameras, the convention that fits them better if there is one, and whether the cameras are
    unusable: another convention fits the matches, or these fit no better than by chance.

    Args:
        matrices: of a file, camera to world if it is right. [M, 4, 4]
        given: the axes that these are said to have. [3, 3]
        lens: focal lengths over the widths [M], focal lengths in pixels [M, 2], and principal points [M, 2].
        matches: of these images.
    """
    problem = _Problem(matrices, lens, matches)
    handed = np.linalg.det(matrices[:, :3, :3]).mean() > 0
    as_given = problem.judged(Convention(given))
    if len(matches.images) < LEAST or np.isnan(as_given.error):
        return as_given, None, False
    if as_given.error <= FINE and problem.are_in_front(as_given):
        return as_given, None, False
    readings = [problem.judged(Convention(axes, inverted)) for axes, inverted in _readings(given)]
    chance = float(np.median([r.error for r in readings]))
    least = min(r.error for r in readings)
    rng = np.random.default_rng(0)
    others = [rng.permutation(len(matrices)) for _ in range(SHUFFLES)]
    shuffled = [_Problem(matrices[order], lens, matches).judged(as_given).error for order in others]
    is_wrong = as_given.error > max(CHANCE * min(chance, float(np.median(shuffled))), HOPELESS)
    best = next(r for r in readings if r.error <= ALIKE * least)
    explains = as_given.error <= FINE or least <= min(BETTER * as_given.error, CHANCE * chance)
    if least > FINE:
        fitted = problem.fitted([best] if explains else readings[:USUAL])
        if fitted.error <= min(BETTER * best.error, GRAVE):
            best, explains = fitted, True
    if not explains:
        return as_given, None, is_wrong
    axes = best.axes if problem.are_in_front(best) else -best.axes
    best = replace(best, axes=axes, mirrored=(np.linalg.det(axes) > 0) != handed)
    is_wrong = as_given.error > GRAVE or best.is_of_axes(given) or abs(np.log(best.focal)) > FOCAL_WRONG
    return as_given, best, bool(is_wrong)


def _readings(given: Array) -> list[tuple[Array, bool]]:
    """Axes and inversions to try, the most usual first; an axis and its opposite alike have the same epipolar lines."""
    usual = [(given, False), (OPENCV, False), (OPENGL, False), (OPENCV, True), (OPENGL, True), (LLFF, False)]
    turns = [np.eye(3)[list(p)] * signs for p in permutations(range(3)) for signs in product([1.0, -1.0], repeat=3)]
    all_readings = usual + [(m * np.linalg.det(m), inverted) for inverted in (False, True) for m in turns]
    return list({(m.round().astype(int).tobytes(), i): (m, i) for m, i in all_readings[::-1]}.values())[::-1]


class _Problem:
    """Distances of matches from the epipolar lines of cameras under a convention."""

    def __init__(self, matrices: Array, lens: tuple[Array, Array, Array], matches: Matches) -> None:
        self.matrices, self.lens, self.matches, (a, b) = matrices, lens, matches, matches.images.T
        self.over_width = lens[0][a]
        self.center = (lens[2] / lens[1])[matches.images]
        self.relative = {}
        for inverted in (False, True):
            poses = np.linalg.inv(matrices) if inverted else matrices
            pose = np.linalg.inv(poses[a]) @ poses[b]
            apart = np.linalg.norm(pose[:, :3, 3], axis=-1, keepdims=True)
            apart[apart <= SAME_PLACE * max(1.0, float(np.abs(poses[:, :3, 3]).max()))] = np.nan
            self.relative[inverted] = pose[:, :3, :3], pose[:, :3, 3] / apart

    def rays(self, convention: Convention) -> Array:
        """Rays of the matches. [N, 2, 3]"""
        at = self.matches.rays if convention.bend is None else self.matches.flat
        scale = convention.focal
        at = at / scale + (self.center * (1 - scale) / scale if convention.moves_center else 0)
        if convention.bend is not None:
            squared = (at * at).sum(-1, keepdims=True)
            at = at * (1 + convention.bend[0] * squared + convention.bend[1] * squared**2)
        return np.concatenate([at, np.ones((*at.shape[:2], 1))], -1)

    def distances(self, convention: Convention) -> Array:
        """Sampson distances over the width, infinite where there is no ray. [N]"""
        rays, axes = self.rays(convention), convention.axes
        turns, shifts = self.relative[convention.inverted]
        # Right, down and forward of both cameras.
        turns, shifts = axes.T @ turns @ axes, shifts @ axes
        lines_a = np.cross(shifts, np.einsum("nij,nj->ni", turns, rays[:, 1]))
        lines_b = np.einsum("nij,ni->nj", turns, np.cross(rays[:, 0], shifts))
        off = (rays[:, 0] * lines_a).sum(-1)
        length = np.hypot(np.linalg.norm(lines_a[:, :2], axis=-1), np.linalg.norm(lines_b[:, :2], axis=-1))
        with np.errstate(invalid="ignore", divide="ignore"):
            distances = np.abs(off) / length * self.over_width * convention.focal
        has_place = np.isfinite(self.relative[False][1]).all(-1)
        return np.nan_to_num(distances[has_place], nan=np.inf, posinf=np.inf)

    def judged(self, convention: Convention) -> Convention:
        """The convention with its error; NaN where all cameras stand in one place."""
        distances = self.distances(convention)
        return replace(convention, error=float(np.median(distances)) if len(distances) else np.nan)

    def are_in_front(self, convention: Convention) -> bool:
        """Whether most points of matches that fit lie in front of both cameras."""
        rays, axes = self.rays(convention), convention.axes
        turns, shifts = self.relative[convention.inverted]
        first, second = rays[:, 0] @ axes.T, np.einsum("nij,nj->ni", turns, rays[:, 1] @ axes.T)
        across = np.cross(first, second)
        # Signs of the distances along both rays at which they meet.
        along = (np.cross(shifts, second) * across).sum(-1), (np.cross(shifts, first) * across).sum(-1)
        ahead = np.stack(along) > 0
        behind = np.stack(along) < 0
        return bool(ahead.all(0).sum() >= behind.all(0).sum())

    def is_plausible(self, convention: Convention) -> bool:
        """Whether the intrinsics are plausible."""
        focal = convention.focal * float(np.median(self.over_width))
        return PLAUSIBLE[0] < focal < PLAUSIBLE[1] and max(map(abs, convention.bend or (0.0,))) < MOST_BENT

    def fitted(self, readings: Sequence[Convention]) -> Convention:
        """The reading with the intrinsics that the matches fit best: the focal length, the lens, or both."""
        few = np.s_[:: max(1, len(self.matches.images) // 800)]
        thin = _Problem(self.matrices, self.lens, Matches(*(x[few] for x in vars(self.matches).values())))
        starts = [
            thin.judged(replace(r, focal=focal, moves_center=moves, bend=bend))
            for r in readings
            for focal in FOCALS
            for moves, bend in ((False, None), (True, None), (False, (0.0, 0.0)))
        ]
        starts = [s for s in starts if self.is_plausible(s)] or starts[:1]
        least = min(start.error for start in starts)
        start = next(s for s in starts if s.error <= ALIKE * least)

        def fit(frees_focal: bool, frees_lens: bool) -> Convention:
            focal = start.focal if frees_focal else 1.0

            def at(values: Array) -> Convention:
                bend = (float(values[-2]), float(values[-1])) if frees_lens else None
                factor = float(np.exp(values[0])) if frees_focal else 1.0
                return replace(start, focal=factor, bend=bend, moves_center=start.moves_center and frees_focal)

            values = [np.log(focal)] * frees_focal + [0.0, 0.0] * frees_lens
            result = minimize(
                lambda v: float(np.minimum(self.distances(at(v)), FAR).mean()) if self.is_plausible(at(v)) else FAR,
                np.array(values),
                method="Nelder-Mead",
                options={"initial_simplex": np.array(values) + 0.05 * np.eye(len(values) + 1, len(values), -1)},
            )
            return self.judged(at(result.x))

        none = self.judged(replace(start, focal=1.0, moves_center=False, bend=(0.0, 0.0)))
        fits = [f for f in (none, fit(True, False), fit(False, True), fit(True, True)) if self.is_plausible(f)] or [
            none
        ]
        least = min(f.error for f in fits)
        return next(f for f in fits if f.error <= ALIKE * least)


def in_words(chosen: Convention, given: Array, focal: float, as_pixels: float, was: float) -> str:
    """Description of a convention for the user: ``given`` are the axes that were expected, ``focal`` is the given focal
    length in pixels, ``as_pixels`` the width, and ``was`` the error as given, over the width."""
    faults = []
    if not np.array_equal(chosen.axes, given):
        rows = [(int(np.abs(row).argmax()), row.sum() < 0) for row in chosen.axes]
        words = ", ".join(f"{n} {DIRECTIONS[k][negative]}" for n, (k, negative) in zip("xyz", rows, strict=True))
        name = next((f"{n} " for n, axes in PROGRAMS if np.array_equal(axes, chosen.axes)), "")
        faults.append(f"have {name}camera axes ({words})")
    if chosen.inverted:
        faults.append("are world to camera, not camera to world")
    if chosen.mirrored:
        faults.append("are those of a left-handed world")
    faults = [f"the matrices {' and '.join(faults)}"] if faults else []
    if chosen.focal != 1.0:
        center = ", and the principal point in proportion" if chosen.moves_center else ""
        faults.append(f"the focal length is {chosen.focal * focal:.0f} px, not {focal:.0f} px{center}")
    if chosen.bend is not None:
        terms = (
            f"about {-chosen.bend[0]:.2g} and {-chosen.bend[1]:.2g} for k1 and k2"
            if any(chosen.bend)
            else "none at all"
        )
        faults.append(f"the lens distortion is wrong or left out ({terms} would fit)")
    text = "; ".join(faults)
    return (
        f"{text[0].upper()}{text[1:]}: then matches agree to {chosen.error * as_pixels:.2f} pixels, as given they are "
        f"off by {was * as_pixels:.1f}."
    )
