"""Scale and up of a model from the places that photos note by GPS (EXIF)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL.ExifTags import GPS

from mmpi_ns.utils.errors import log
from mmpi_priors.upright import level_up

RADIUS, SQUARED = 6_378_137.0, 0.00669438
"""Equatorial radius of the Earth in metres, and the squared eccentricity of its meridians (WGS 84)."""
LEAST, SHARE = 8, 0.5
"""Places, and share of the images, from which GPS counts: a similarity has seven numbers and fits few places anyhow."""
AGREES = 0.1
"""Largest error over the extent of the path for metres: the scale is then good to about as much. Places that have
nothing to do with a path have 0.3, eight of them once in a hundred times less than 0.1."""
LEVEL = 0.15
"""Largest error over the spread across the path for up. The tilt is wrong by about a third of it (errors upwards alone
count, and average somewhat), three degrees: cameras are held about as level. Of a straight path, however long, GPS does
not tell how far it is tilted to the side."""
TRIALS, OFF, ROUNDS = 500, 3.0, 5
"""Minimal sets that are tried, median errors from which a place is left out, and rounds of leaving out."""
Array = NDArray[np.float64]
Place = tuple[float, float, float]


@dataclass(frozen=True)
class Fit:
    """How a model lies in the world."""

    scale: float
    """Metres for a unit of the model."""
    up: Array | None
    """Unit vector in the model; None where GPS does not tell it. [3]"""
    summary: str
    """Photos and error in words."""


def place_of(tags: Any) -> Place | None:
    """Latitude and longitude in degrees and altitude in metres (NaN where missing) of the GPS tags of a photo; None
    where they are missing or damaged, or all zero, as receivers without a fix note."""
    try:
        latitude, longitude = (
            sum(float(part) / 60**i for i, part in enumerate(tags[value])) * (-1 if tags.get(side) in ("S", "W") else 1)
            for value, side in ((GPS.GPSLatitude, GPS.GPSLatitudeRef), (GPS.GPSLongitude, GPS.GPSLongitudeRef))
        )
        below = tags.get(GPS.GPSAltitudeRef) in (b"\x01", 1)
        altitude = float(tags.get(GPS.GPSAltitude, np.nan)) * (-1 if below else 1)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
        return None
    return latitude, longitude, altitude


def in_metres(places: Array) -> Array:
    """East, north and up of places, as by ``place_of``, from their median, exact to a thousandth over a few kilometres.
    [N, 3] each"""
    middle = np.median(places, 0)
    east, north = np.radians((places[:, :2] - middle[:2] + 180) % 360 - 180).T[::-1]
    sine = np.sin(np.radians(middle[0]))
    across = RADIUS / np.sqrt(1 - SQUARED * sine**2)  # radii of curvature: of the parallel's normal, of the meridian
    along = across * (1 - SQUARED) / (1 - SQUARED * sine**2)
    return np.stack([east * across * np.sqrt(1 - sine**2), north * along, places[:, 2] - middle[2]], -1)


def aligned(source: Array, target: Array, kept: NDArray[np.integer]) -> tuple[float, Array, Array]:
    """The similarity by least squares from the ``kept`` points to others, [N, D] each: its scale, its rotation [D, D],
    and the error of each point [N].

    Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns (1991).
    """
    a, b = source - source[kept].mean(0), target - target[kept].mean(0)
    u, sizes, vt = np.linalg.svd(b[kept].T @ a[kept])
    signs = np.ones(len(sizes))
    signs[-1] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * signs) @ vt
    scale = float((sizes * signs).sum() / max(float((a[kept] ** 2).sum()), 1e-24))
    return scale, rotation, np.linalg.norm(b - scale * a @ rotation.T, axis=-1)


def robustly(source: Array, target: Array) -> tuple[float, Array, Array]:
    """``aligned`` by points that agree: the least median of minimal sets of them, then all that agree with it."""
    random, (count, size) = np.random.default_rng(0), source.shape
    middle = (count + size) // 2  # of the errors of those that are in no minimal set
    sets = (random.choice(count, size, replace=False) for _ in range(TRIALS))
    best = min((aligned(source, target, some) for some in sets), key=lambda fit: np.sort(fit[2])[middle])
    for _ in range(ROUNDS):
        errors = best[2]
        best = aligned(source, target, np.flatnonzero(errors <= OFF * max(np.sort(errors)[middle], 1e-9)))
    return best


def find_fit(poses: Array, places: Sequence[Place | None]) -> Fit | None:
    """Scale and up of a model's cameras by the places of their photos, said in a sentence; None where these are too
    few, or contradict the cameras.

    Up is that of GPS where the path is wide enough; else cameras are taken to be level, and altitudes are left out.

    ``poses`` are camera to world, OpenCV axes. [N, 4, 4]
    """
    noted = [i for i, place in enumerate(places) if place is not None]
    if not noted:
        return None
    centers, metres = poses[noted, :3, 3], in_metres(np.array([places[i] for i in noted], np.float64))
    count = len(np.unique(metres[:, :2].round(1), axis=0))
    if count < LEAST or len(noted) < SHARE * len(poses):
        log(f"GPS of {len(noted)} photos at {count} places is too little for metres.")
        return None
    level, _ = level_up(poses[:, :3, 0], -poses[:, :3, 1])
    plane = np.linalg.svd(level[None])[2][1:]  # two axes across up, as east and north are
    plane[1] *= np.sign(np.cross(*plane) @ level)
    up, what, (scale, _, errors) = None, "Metres", robustly(centers @ plane.T, metres[:, :2])
    if np.isfinite(metres).all():
        whole = robustly(centers, metres)
        across = whole[0] * np.linalg.svd(centers - centers.mean(0), compute_uv=False)[1] / np.sqrt(len(noted))
        if np.median(whole[2]) <= LEVEL * across:
            up, what, (scale, _, errors) = whole[1][2], "Metres and up", whole
    error = float(np.median(errors))
    extent = scale * float(np.ptp(centers @ np.linalg.svd(centers - centers.mean(0))[2][0]))
    if error > AGREES * extent:
        log(f"Metres are not known: GPS of {len(noted)} photos differs by {error:.1f} m from a path of {extent:.0f}.")
        return None
    kept = np.count_nonzero(errors <= OFF * max(error, 1e-9))
    number = f"{kept}" if kept == len(noted) else f"{kept} of {len(noted)}"
    summary = f"GPS of {number} photos: they agree to {error:.1f} m of {extent:.0f}"
    log(f"{what} from {summary}.")
    return Fit(scale, up, summary)
