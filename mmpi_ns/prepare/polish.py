"""Final bundle adjustment with a robust loss, with more parameters free if the images support it."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pycolmap

from mmpi_ns.prepare.mapping import adjust, bundle_options
from mmpi_ns.prepare.stages import progress, say

WORTH = 0.97
"""Fraction of the reprojection error to which a freed parameter must lower it."""


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
    """The model adjusted with a robust loss, and again with more parameters free if that lowers the error.

    Parameters that do not lower it absorb other errors: driving forward, lens terms absorb the principal point.

    Args:
        model: not changed.
        free: what may be refined.
        threads: CPU threads; below 1 for all.
    """
    trials: list[tuple[str, Callable[[pycolmap.Reconstruction], None]]] = []
    if free.principal_point and not free.always:
        trials.append(("the principal point free", lambda model: None))
    if free.full_lens and any(c.model.name == "SIMPLE_RADIAL" for c in model.cameras.values()):
        trials.append(("OpenCV's four lens terms", _give_four_terms))
    principal_point = free.always
    with progress("Fitting the lens", 1 + len(trials)) as advance:
        best = copy.deepcopy(model)
        adjust(best, bundle_options(True, free.lens, principal_point, threads, robust=True))
        advance()
        for says, change in trials:
            trial = copy.deepcopy(best)
            change(trial)
            also = principal_point or change is not _give_four_terms
            adjust(trial, bundle_options(True, free.lens, also, threads, robust=True))
            advance()
            before, after = error(best), error(trial)
            kept = after < WORTH * before
            say(f"Lens: {before:.3f} px, {after:.3f} px with {says}: {'kept' if kept else 'not kept'}.")
            if kept:
                best, principal_point = trial, also
    return best


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
