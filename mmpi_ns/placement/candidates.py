"""Candidates for MPIs: a generous list, from which ``rule.py`` chooses.

They are frusta of training cameras, some pulled back, some widened: seen from its own origin an MPI has no plane error
and texels as fine as pixels. (MPIs that face sideways, up or down at a camera, and cubes around objects, measured
worse.)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.placement.errors import pixel_slopes
from mmpi_ns.placement.observations import Array, Observations, VisiblePoints, farthest_first
from mmpi_ns.scene.plan import MPIPlan, Vector
from mmpi_ns.utils.errors import InputError

MAX_VIEWS, MAX_WIDE_VIEWS = 96, 32
"""Number of training cameras used for candidates, spread over all; fewer for wide lenses, which have several each."""
FACES = ("front", "left", "right", "above", "below", "back")
"""Facing directions of MPIs at a wide camera; each covers the directions nearest to it, with a margin."""
BESIDE = 0.9
"""Minimum component of a direction along a face that contains it, relative to its largest component."""
MARGINS = (1.12, 1.4, 1.75)
"""Frusta of views, relative to the camera's own."""
PULL_BACKS = (0.0, 1.0, 2.0)
"""Distances of an MPI behind its camera, relative to the depth at which points start."""
NEAR_SHARE = 0.6
"""Depth of the first plane, relative to that at which points start."""


def vector(v: Array) -> Vector:
    return (float(v[0]), float(v[1]), float(v[2]))


def facing_axes(base: Array, name: str) -> tuple[Vector, Vector, Vector]:
    """Rows x, y, z of an MPI that faces ``name`` in a frame with rows right, down, forward."""
    right, down, forward = base
    x, y, z = {
        "front": (right, down, forward),
        "back": (-right, down, -forward),
        "left": (forward, down, -right),
        "right": (-forward, down, right),
        "below": (right, -forward, down),
        "above": (right, forward, -down),
    }[name]
    return vector(x), vector(y), vector(z)


@dataclass(frozen=True)
class Candidate:
    """A candidate MPI of any resolution, and its expected errors."""

    frame: MPIPlan
    """Pose and extent; its planes and texels are not set yet."""
    rows: float
    """Rows if a texel spans one pixel, seen from the MPI's origin."""
    columns: float
    plane: NDArray[np.float32]
    """[Q] e_p of each observation with two planes, in pixels: with L planes it is plane / (L - 1)."""
    texel: NDArray[np.float32]
    """[Q] e_t of each observation, relative to the pixels of a texel; inf if the candidate does not contain it."""

    def at(self, texel_pixels: float, planes: int) -> MPIPlan:
        """The MPI with texels of this many pixels."""
        height, width = (max(8, round(n / texel_pixels) + 1) for n in (self.rows, self.columns))
        return replace(self.frame, planes=planes, height=height, width=width)


def find_candidates(observations: Observations, visible: VisiblePoints) -> list[Candidate]:
    """Views of training cameras that are spread over the capture. Raises InputError if no camera has a field of view
    that an MPI can have."""
    centers, back = observations.centers / max(visible.near, 1e-12), observations.camera_to_worlds[:, :, 2]
    places = np.concatenate([centers, back * 2], -1)
    most, candidates = MAX_WIDE_VIEWS if observations.wide.any() else MAX_VIEWS, []
    for i in farthest_first(places, count=min(most, len(places))):  # far apart in position or direction
        fx, fy = observations.intrinsics[i, :2]
        for (name, axes, u, v), pull_back in product(_faces(observations, i), PULL_BACKS):
            behind = pull_back * visible.near
            origin = observations.centers[i] - behind * axes[2]
            near = float(NEAR_SHARE * min(visible.nearest[i], visible.near) + behind)
            frame = vector(origin), (vector(axes[0]), vector(axes[1]), vector(axes[2])), near
            # Views that differ in their margin alone have the errors of the widest.
            widest = MPIPlan(name, *frame, _widened(u, v, max(MARGINS)), planes=2, height=2, width=2)
            plane, across, down = pixel_slopes(widest, observations, visible.cameras, visible.points)
            plane, texel = 0.5 / near * plane, np.maximum(across / fx, down / fy)
            x, y, z = ((visible.points - origin) @ axes.T).T
            for margin in MARGINS:
                u0, u1, v0, v1 = extent = _widened(u, v, margin)
                held = (x >= u0 * z) & (x <= u1 * z) & (y >= v0 * z) & (y <= v1 * z)
                errors = (np.where(held, values, np.inf).astype(np.float32) for values in (plane, texel))
                view = replace(widest, extent=extent)
                candidates.append(Candidate(view, float((v1 - v0) * fy), float((u1 - u0) * fx), *errors))
    if not candidates:
        raise InputError(
            "No MPI fits the field of view of any training camera: check camera_model, focal lengths and distortion."
        )
    return candidates


def _faces(observations: Observations, i: int) -> Iterator[tuple[str, Array, Array, Array]]:
    """Facing directions of MPIs at a camera: its own, and for a wide lens also its sides. For each the name, axes (rows
    right, down, facing), and smallest and largest tangents that the camera sees to the right and downwards."""
    right, up, back = observations.camera_to_worlds[i, :, :3].T
    axes, name = np.stack([right, -up, -back]), f"view {i + 1}"
    if observations.lens is None:
        fx, fy, cx, cy = observations.intrinsics[i]
        width, height = observations.sizes[i]
        yield name, axes, np.array([-cx, width - cx]) / fx, np.array([-cy, height - cy]) / fy
        return
    seen = observations.lens[i].reshape(-1, 3) * [1, -1, -1]
    for face in FACES if observations.wide[i] else FACES[:1]:
        turn: Array = np.array(facing_axes(np.eye(3), face))
        x, y, ahead = local = turn @ seen.T
        inside = ahead >= BESIDE * np.abs(local).max(0) if observations.wide[i] else ahead > 1e-3
        if inside.sum() > 2:
            u, v = (np.array([t.min(), t.max()]) for t in (x[inside] / ahead[inside], y[inside] / ahead[inside]))
            if min(np.ptp(u), np.ptp(v)) > 1e-3:
                yield name if face == "front" else f"{name} {face}", np.matmul(turn, axes), u, v


def _widened(u: Array, v: Array, margin: float) -> tuple[float, float, float, float]:
    """A frustum's tangents (u0, u1, v0, v1), ``margin`` times as wide and high about its middle."""
    u0, u1, v0, v1 = (float(x) for side in (u, v) for x in side.mean() + margin * (side - side.mean()))
    return u0, u1, v0, v1
