"""What moves along with the camera or towards it: clues that need no difference of colours.

A match of a static point lies on its epipolar line, at a distance that is neither below the ground nor behind the
camera. A car ahead that keeps its distance, or overtakes, is matched at an inverse depth of 0 or less, below the
ground. Flow finds small motions only, so each neighbour is first warped as the static scene would move, and then as
infinitely distant content would. A car that comes towards the camera is matched at a possible depth, nearer than it is:
it hangs in the air.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mmpi_ns.capture.dense import Parallax, correlation
from mmpi_ns.capture.moving_evidence import SOLID, Mask, Shot, nearest_known
from mmpi_ns.capture.views import Map, View, look_up, pixel_grid

NEIGHBOURS, VOTES = 4, 2
"""Nearest neighbours that are matched, and those of them that must show motion."""
ALIKE, EXPLAINS, CONTRAST = 0.85, 0.7, 3.0
"""Correlation of a match that shows motion and of one that a static point may have, and standard deviation of gray
levels around it, at least."""
OFF_LINE = 1.2
"""Pixels that a match may lie off the epipolar line: beside it, depths mean nothing."""
NOISE, ERRORS = 0.5, 3.0
"""Error of a match in pixels, and multiples of the error of its inverse depth by which it is impossible."""
FLOATS = 1.5
"""Inverse depth of a thing over that of the ground just below it, at least, for it to hang in the air."""
FAR = 1e30
EDGE, LEAST_PIXELS = 1.2, 20
"""Factor by which inverse depths next to each other differ at the edge of a thing, and pixels of one, at least."""
GAP, BARE = 24, 0.6
"""Pixels below it in which the first known depth must be the ground's, and share of its columns where it is."""
STRAIGHT = 0.05
"""Distance of cameras from a straight line over the length of their path, at most: else depths are what they seem."""


def moves_apart(shot: Shot, others: Sequence[Shot], flow: cv2.DISOpticalFlow) -> Mask:
    """Where several neighbours are matched at a depth below the ground alone. [h, w]"""
    view, inverse = shot.view, shot.depth.inverse
    votes, nowhere, ground = np.zeros(view.gray.shape, np.uint8), np.zeros_like(inverse), shot.ground
    if ground is None:
        return votes > 0
    static = nearest_known(inverse) if inverse.any() else nowhere
    static = np.where((inverse == 0) & (ground > 0), ground, static)
    contrast = correlation(view.gray, view.gray)[1]
    for other in others[:NEIGHBOURS]:
        parallax = Parallax.between(view, other.view)
        # Along an edge that points to where the camera goes every depth matches: what stands still is asked first.
        stands = _alike(view, other.view, *parallax.pixels(static)[:2]) > EXPLAINS
        moves = np.zeros_like(stands)
        for start in (static, nowhere):
            match = _match(view, other.view, parallax, start, flow)
            # Above the horizon only what is behind the camera is impossible, and rows of windows are matched there.
            possible = (match.inverse + ERRORS * match.error > SOLID * ground) | (ground == 0)
            on_line = match.off_line < OFF_LINE
            stands |= (match.alike > EXPLAINS) & on_line & possible
            moves |= (match.alike > ALIKE) & on_line & ~possible
        votes += moves & ~stands & (contrast > CONTRAST) & view.inside
    return votes >= VOTES


@dataclass(frozen=True)
class _Match:
    """Where a view's pixels are seen in another one. [h, w] each"""

    alike: Map
    """Correlation; -1 outside."""
    inverse: Map
    """Inverse depth, and its expected error."""
    error: Map
    off_line: Map
    """Pixels off the epipolar line."""


def _match(view: View, other: View, parallax: Parallax, start: Map, flow: cv2.DISOpticalFlow) -> _Match:
    """Matches near where pixels would be seen at some inverse depths."""
    x, y, _ = parallax.pixels(start)
    motion = np.asarray(flow.calc(view.gray, look_up(other.gray, x, y), None))  # type: ignore[call-overload]
    grid_x, grid_y = pixel_grid(view.gray.shape)
    moved = grid_x + motion[..., 0], grid_y + motion[..., 1]
    x, y = look_up(x, *moved), look_up(y, *moved)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        inverse, off_line, across = parallax.solve(x, y, np.s_[0 : x.shape[0]])
        alike = np.where(np.isfinite(off_line) & (across > 0), _alike(view, other, x, y), -1)
        return _Match(alike, inverse, NOISE / np.sqrt(across), np.sqrt(off_line))


def _alike(view: View, other: View, x: Map, y: Map) -> Map:
    """Correlation of a view with another one at some of its pixels; -1 outside. [h, w]"""
    seen = look_up(np.ascontiguousarray(other.inside, np.uint8), x, y, nearest=True) > 0
    return np.where(seen, correlation(view.gray, look_up(other.gray, x, y))[0], -1)


def floats(shot: Shot, others: Sequence[Shot]) -> Mask:
    """What seems to hang in the air, as a car does that comes towards a camera: nearer than it is, and smaller. [h, w]

    A camera that goes straight on cannot tell it from a static thing but by where it stands.
    """
    result = np.zeros(shot.view.gray.shape, bool)
    centers = np.stack([s.view.pose[:, 3] for s in (shot, *others)])
    sizes = np.linalg.svd(centers - centers.mean(0), compute_uv=False)
    if shot.ground is None or len(centers) < 3 or sizes[1] > STRAIGHT * sizes[0]:
        return result
    inverse, ground = shot.depth.inverse, shot.ground
    kernel = np.ones((3, 3), np.uint8)
    smallest = cv2.erode(np.where(inverse > 0, inverse, FAR).astype(np.float32), kernel)
    whole = cv2.dilate(inverse, kernel) < EDGE * smallest  # things end where depth jumps
    stands = (inverse > FLOATS * ground) & (inverse > 0) & whole
    on_ground = (inverse > 0) & (np.abs(inverse - ground) < 0.15 * ground)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(stands.astype(np.uint8))
    for label in np.flatnonzero(boxes[:, cv2.CC_STAT_AREA] >= LEAST_PIXELS)[1:]:
        left, top, width, height = boxes[label, :4]
        window = np.s_[top : top + height + GAP, left : left + width]
        part = labels[window] == label
        last = len(part) - 1 - part[::-1].argmax(0)
        columns = np.flatnonzero(part.any(0))
        below = np.arange(len(part))[:, None] > last[columns]
        shown = ((inverse > 0) & whole)[window][:, columns] & below
        first = shown.argmax(0)
        bare = shown.any(0) & on_ground[window][first, columns] & (ground[window][last[columns], columns] > 0)
        if bare.mean() > BARE:
            result[top : top + len(part), left : left + width] |= part
    return result
