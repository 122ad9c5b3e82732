"""Final bundle adjustment with a robust loss, with more parameters free if the images support it."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from mmpi_ns.capture.matching import MIN_ANGLE, quiet, triangulate_points
from mmpi_ns.prepare.mapping import adjust, bundle_options
from mmpi_ns.prepare.stages import progress, say

WORTH = 0.97
"""Fraction of the reprojection error to which a freed parameter must lower it."""
LARGEST_ERROR = 4.0
"""Reprojection error in pixels above which an observation is dropped."""
ENOUGH_POINTS = 300
"""Points of each image, those that most images see, on which a choice between camera models rests."""


@dataclass(frozen=True)
class Free:
    """What may be refined of the cameras."""

    lens: bool
    """Focal length and distortion."""
    full_lens: bool
    """OpenCV's four lens terms in place of one radial term, if they fit clearly better."""
    principal_point: bool
    """The principal point, if that fits clearly better. It is hardly observable on straight stretches, but in bends."""
    always: bool = False
    """The principal point, in any case."""


def polish(model: pycolmap.Reconstruction, free: Free, threads: int) -> pycolmap.Reconstruction:
    """The model adjusted with more parameters free, if that lowers the error.

    Parameters that do not lower it absorb other errors: driving forward, lens terms absorb the principal point.

    Args:
        model: adjusted; not changed.
        free: what may be refined.
        threads: CPU threads; below 1 for all.
    """
    trials: list[tuple[str, Callable[[pycolmap.Reconstruction], None], bool]] = []
    if free.principal_point and not free.always:
        trials.append(("the principal point free", lambda model: None, True))
    if free.full_lens and any(c.model.name == "SIMPLE_RADIAL" for c in model.cameras.values()):
        trials.append(("OpenCV's four lens terms", _give_four_terms, False))
    place = free.always
    with progress("Fitting the lens", 1 + len(trials)) as advance:
        best = copy.deepcopy(model)
        if place:
            adjust(best, bundle_options(True, free.lens, place, threads, robust=True))
        advance()
        light = with_fewer_points(best)
        if trials:
            adjust(light, bundle_options(True, free.lens, place, threads, robust=True))
        changes = []
        for says, change, also in trials:
            trial = copy.deepcopy(light)
            change(trial)
            adjust(trial, bundle_options(True, free.lens, place or also, threads, robust=True))
            advance()
            before, after = error(light), error(trial)
            kept = after < WORTH * before
            say(f"Lens: {before:.3f} px, {after:.3f} px with {says}: {'kept' if kept else 'not kept'}.")
            if kept:
                light, place = trial, place or also
                changes.append(change)
        if changes:
            for change in changes:
                change(best)
            adjust(best, bundle_options(True, free.lens, place, threads, robust=True))
    return best


def with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with the points that most images see, so many for each image: as telling, and quickly adjusted."""
    light = copy.deepcopy(model)
    counts = dict.fromkeys(light.reg_image_ids(), 0)
    tracks = {i: [e.image_id for e in p.track.elements] for i, p in light.points3D.items()}
    for number in sorted(tracks, key=lambda i: (-len(tracks[i]), i)):
        if all(counts[image] >= ENOUGH_POINTS for image in tracks[number]):
            light.delete_point3D(number)
        else:
            for image in tracks[number]:
                counts[image] += 1
    return light


def error(model: pycolmap.Reconstruction) -> float:
    """Root mean square of the points' reprojection errors, each counted once for each image that sees it; pixels."""
    errors = np.array([p.error for p in model.points3D.values()])
    lengths = np.array([p.track.length() for p in model.points3D.values()])
    return float(np.sqrt((errors**2 * lengths).sum() / max(int(lengths.sum()), 1)))


def _give_four_terms(model: pycolmap.Reconstruction) -> None:
    """Cameras of one radial term become OpenCV's, with the others at zero."""
    for camera in model.cameras.values():
        if camera.model.name == "SIMPLE_RADIAL":
            f, cx, cy, k = camera.params
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [f, f, cx, cy, k, 0.0, 0.0, 0.0]


def with_all_points(
    model: pycolmap.Reconstruction, database: Path, images: Path, refine: bool, threads: int, rounds: int = 1
) -> pycolmap.Reconstruction:
    """A placed model with the points of all verified matches, and everything adjusted to them, so many times.

    In place of COLMAP's own last step, which takes longer, and leaves out many points of sequences with small angles:
    of every second frame of a drive with bends half of the matches became points, with this three quarters.
    """
    for _ in range(rounds):
        with quiet():
            model = triangulate_points(model, database, images, threads, LARGEST_ERROR)
        adjust(model, bundle_options(True, refine, False, threads, robust=True))
        pycolmap.ObservationManager(model).filter_all_points3D(LARGEST_ERROR, MIN_ANGLE)
        model.update_point_3d_errors()
    return model
