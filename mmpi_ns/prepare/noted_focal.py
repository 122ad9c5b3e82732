"""The focal length that EXIF notes, where the images hardly determine it: if all cameras look the same way and move
across it, as on a level flight, everything twice as far away through a lens twice as long shows the same."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from mmpi_ns.prepare.adjustment import LARGEST_ERROR, adjust, with_fewer_points
from mmpi_ns.utils.errors import say

OFF, WORTH, ROUNDS = 0.1, 0.95, 3
"""Relative difference of a refined focal length from that of EXIF, which is rounded, from which it is asked whether the
images determine it; share of the reprojection error with that of EXIF to which they must lower it; and adjustments with
that of EXIF, as it changes all heights."""


def with_focals(model: pycolmap.Reconstruction, focals: Mapping[int, float], threads: int) -> pycolmap.Reconstruction:
    """A copy adjusted with given focal lengths, in pixels by camera; those of other cameras stay."""
    held = copy.deepcopy(model)
    for number, camera in held.cameras.items():
        if number in focals:
            camera.params[camera.focal_length_idxs()] = focals[number]
    for _ in range(ROUNDS):
        adjust(held, threads, lens=True, focal=False)
    return held


def open_focals(model: pycolmap.Reconstruction, database: Path, threads: int) -> dict[int, float]:
    """Focal lengths that a database of features has from EXIF, in pixels by camera, if the images hardly determine
    them, but end elsewhere: with those of EXIF the error is hardly larger. Else empty."""
    with pycolmap.Database.open(database) as opened:
        cameras = [c for c in opened.read_all_cameras() if c.has_prior_focal_length]
    noted = {c.camera_id: c.mean_focal_length() for c in cameras}
    apart = [abs(camera.mean_focal_length() / noted[n] - 1) for n, camera in model.cameras.items() if n in noted]
    if not apart or max(apart) < OFF:
        return {}
    light = with_fewer_points(model)
    adjust(light, threads, lens=True)
    # Root mean squares of the points' errors in pixels, where single points that are lost count little.
    errors = (
        np.array([min(point.error, LARGEST_ERROR) for point in m.points3D.values()])
        for m in (light, with_focals(light, noted, threads))
    )
    free, held = (float(np.sqrt((each**2).mean())) for each in errors)
    is_open = free > WORTH * held
    focals = ", ".join(f"{focal:.0f}" for _, focal in sorted(noted.items())[:3])
    fate = "kept, as the images hardly determine it" if is_open else "not kept"
    say(f"Lens: {free:.3f} px, {held:.3f} px with the focal length of EXIF ({focals} px): {fate}.")
    return noted if is_open else {}
